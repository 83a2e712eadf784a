//! The command line: arguments, progress, exit codes. It contains no algorithms.

/// Prints a line to stdout; see [`stdout::print_line`].
macro_rules! out {
    ($($text:tt)*) => {
        crate::stdout::print_line(format_args!($($text)*))
    };
}

/// Prints a message to stderr as the standard macro does, with control characters escaped; see [`stdout::printable`].
macro_rules! eprintln {
    ($($text:tt)*) => {
        crate::stdout::print_message(format_args!($($text)*))
    };
}

mod bench;
mod bench_report;
mod calibrate;
mod calibration_table;
mod check;
mod commands;
mod data;
mod device;
mod devices;
mod dicom_args;
mod eval;
mod exit;
mod export;
mod frame_rates;
mod geometry_picture;
mod igtl_server;
mod info;
mod kernels;
mod lesion_section;
mod lettering;
mod memory;
mod next;
mod options;
mod output;
mod page;
mod picture_args;
mod plot;
mod progress;
mod render;
mod report;
mod rtk_args;
mod score_table;
mod selftest;
mod stdout;
mod study;
mod study_page;
mod synthetic_args;
mod train;
mod tree;
mod tree_section;
mod tree_table;
mod view;
mod view_server;
mod view_tree;
mod viewpoint;
mod volume_table;
mod watch;
mod watch_leave;
mod watch_live;

use clap::Parser;
use commands::Cli;
use std::process::ExitCode;

fn main() -> ExitCode {
    let cli = Cli::parse();
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_env_filter(tracing_subscriber::EnvFilter::new(if cli.global.verbose {
            "info,nertca_vk=debug,nertca_vk_gpu=debug"
        } else {
            "error"
        }))
        .without_time()
        .init();
    ignore_file_size_signal();
    match cli.run().and_then(|()| stdout::finish()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("nertca-vk: {error}");
            if let Some(hint) = exit::hint(&error) {
                eprintln!("nertca-vk: hint: {hint}");
            }
            ExitCode::from(exit::code(&error))
        }
    }
}

/// Makes a write beyond the limit of file sizes (`ulimit -f`) an ordinary error, where the system would end the program by a
/// signal and leave partial files.
#[cfg(unix)]
fn ignore_file_size_signal() {
    // SAFETY: an ignored signal runs no handler, and nothing else in this process concerns itself with this signal.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
    }
}

#[cfg(not(unix))]
fn ignore_file_size_signal() {}
