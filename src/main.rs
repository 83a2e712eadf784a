//! The command line: arguments, progress, exit codes. It contains no algorithms.

/// Prints a line to stdout. A closed stdout (as with `| head`) is not an error.
macro_rules! out {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($text)*);
    }};
}

mod cli {
    pub mod bench;
    pub mod bench_report;
    pub mod calibrate;
    pub mod calibration_table;
    pub mod check;
    pub mod commands;
    pub mod data;
    pub mod device;
    pub mod devices;
    pub mod dicom_args;
    pub mod eval;
    pub mod exit;
    pub mod export;
    pub mod frame_rates;
    pub mod geometry_picture;
    pub mod info;
    pub mod kernels;
    pub mod lettering;
    pub mod options;
    pub mod page;
    pub mod plot;
    pub mod progress;
    pub mod render;
    pub mod report;
    pub mod score_table;
    pub mod selftest;
    pub mod study;
    pub mod study_page;
    pub mod synthetic_args;
    pub mod train;
    pub mod tree;
    pub mod tree_section;
    pub mod tree_table;
    pub mod view;
    pub mod view_server;
    pub mod view_tree;
    pub mod viewpoint;
    pub mod volume_table;
    pub mod watch;
    pub mod watch_leave;
    pub mod watch_live;
}

use clap::Parser;
use cli::commands::Cli;
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
    match cli.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("nertca-vk: {error}");
            if let Some(hint) = cli::exit::hint(&error) {
                eprintln!("nertca-vk: hint: {hint}");
            }
            ExitCode::from(cli::exit::code(&error))
        }
    }
}
