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

/// Arguments of commands.
mod args {
    pub(crate) mod dicom_args;
    pub(crate) mod options;
    pub(crate) mod picture_args;
    pub(crate) mod rtk_args;
    pub(crate) mod synthetic_args;
    pub(crate) mod viewpoint;
}

/// Commands, one file for each.
mod command {
    pub(crate) mod bench;
    pub(crate) mod calibrate;
    pub(crate) mod check;
    pub(crate) mod data;
    pub(crate) mod devices;
    pub(crate) mod eval;
    pub(crate) mod export;
    pub(crate) mod info;
    pub(crate) mod kernels;
    pub(crate) mod next;
    pub(crate) mod render;
    pub(crate) mod selftest;
    pub(crate) mod study;
    pub(crate) mod train;
    pub(crate) mod tree;
}

/// Pages, tables and pictures of results.
mod pages {
    pub(crate) mod bench_report;
    pub(crate) mod calibration_table;
    pub(crate) mod geometry_picture;
    pub(crate) mod lesion_section;
    pub(crate) mod lettering;
    pub(crate) mod page;
    pub(crate) mod plot;
    pub(crate) mod report;
    pub(crate) mod score_table;
    pub(crate) mod study_page;
    pub(crate) mod tree_section;
    pub(crate) mod tree_table;
    pub(crate) mod volume_table;
}

/// The viewer in a browser and the OpenIGTLink server.
mod viewer {
    pub(crate) mod frame_rates;
    pub(crate) mod igtl_server;
    pub(crate) mod view;
    pub(crate) mod view_server;
    pub(crate) mod view_tree;
}

mod commands;
mod device;
mod exit;
mod memory;
mod output;
mod progress;
mod stdout;
mod watch;

use clap::Parser;
use commands::Cli;
use nertca_vk::error::Result;
use std::process::ExitCode;

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(shown) => return show(&shown),
    };
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
    ended(cli.run().and_then(|()| stdout::finish()))
}

/// Shows help, the version, or what is wrong with the arguments.
fn show(shown: &clap::Error) -> ExitCode {
    if let Err(error) = shown.print() {
        stdout::keep(error);
    }
    match shown.use_stderr() {
        true => shown.exit_code().try_into().map_or(ExitCode::FAILURE, |code: u8| ExitCode::from(code)),
        false => ended(stdout::finish()),
    }
}

/// Prints the error of a command, if it has one, and returns its exit code.
fn ended(outcome: Result<()>) -> ExitCode {
    match outcome {
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
