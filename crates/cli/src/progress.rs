//! Progress of a run, as text for people and as JSON for programs, and the signals that stop it.

use crate::stdout::printable;
use indicatif::{ProgressBar, ProgressStyle};
use nertca_vk::error::{Error, Result};
use nertca_vk::fitting::losses::LargeLoss;
use nertca_vk_runs::run::events::Event;
use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A dynamic field that leaves more than this share of the loss explains little.
const EXPLAINS_LITTLE: f64 = 0.9;

/// Repeated fits that agree on less than this share of their vessels are partly false: of data sets with Dice of .78 or more the least is .76,
/// and a data set whose views were not adjusted as they should have been, with Dice of .50, has .59.
const FITS_AGREE: f64 = 0.7;

/// Returns a flag that Ctrl-C and SIGTERM set; a second signal ends the program at once.
pub fn stop_flag() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let seen = stop.clone();
    ctrlc::set_handler(move || {
        if seen.swap(true, Ordering::Relaxed) {
            crate::exit::interrupted();
        }
        eprintln!("nertca-vk: the program will stop after the current work; press Ctrl-C again to stop immediately");
    })
    .map_err(|e| Error::Internal(format!("the Ctrl-C handler could not be set: {e}")))?;
    Ok(stop)
}

/// Makes Ctrl-C and SIGTERM end the program at once, after what it is writing has been removed. For commands without work that
/// could be continued.
pub fn clean_up_on_signals() -> Result<()> {
    ctrlc::set_handler(|| crate::exit::interrupted())
        .map_err(|e| Error::Internal(format!("the Ctrl-C handler could not be set: {e}")))
}

/// Prints an event as one line of JSON on stdout.
pub fn print_json(event: &Event) {
    if let Ok(line) = serde_json::to_string(event) {
        out!("{line}");
    }
}

fn bar(template: &str) -> ProgressBar {
    let bar = ProgressBar::new(1);
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    bar
}

/// Strongest line integral of the dynamic field, as a share of that of both fields, below which it has vanished: a network begins with 1e-3
/// and more, filled vessels have a tenth, and fields that had vanished had 1e-9 and less.
const VANISHED: f64 = 1e-6;

/// Returns a note on the data as a line; a warning stands for itself.
fn noted(note: &str) -> String {
    if note.starts_with("warning: ") { note.to_owned() } else { format!("- {note}") }
}

/// Returns a warning about a dynamic field that was zero after `step` iterations.
fn of_vanished(step: u32) -> String {
    format!(
        "warning: after {step} iterations the dynamic field is zero everywhere, from where its network does not return: the result will \
         have no vessels. End the run with Ctrl-C, and take a lower dynamic.lr or the preset nert-ca"
    )
}

/// Returns an observer that shows a bar and lines on stderr.
pub fn show_progress() -> impl FnMut(&Event) {
    let terminal = std::io::stderr().is_terminal();
    let bar = bar("[{bar:30}] {pos}/{len} {msg}");
    let say = move |bar: &ProgressBar, text: String| {
        if terminal { bar.println(printable(&text)) } else { eprintln!("{text}") }
    };
    let mut evaluation = show_evaluation();
    let mut has_vanished = false;
    move |event| match event {
        Event::Started { device, step, iterations, parameters, notes } => {
            bar.set_length(u64::from(*iterations));
            bar.set_position(u64::from(*step));
            say(&bar, format!("{device}: {parameters} parameters"));
            notes.iter().for_each(|note| say(&bar, noted(note)));
        }
        Event::Memory { host_mib, device_mib, together_mib } => say(
            &bar,
            format!(
                "memory: about {host_mib} MiB of the host and {device_mib} MiB of the device, or {together_mib} MiB where they share it"
            ),
        ),
        Event::Checked { conclusion, check, .. } => {
            let warning = if check.faulty() { "warning: " } else { "- " };
            say(&bar, format!("{warning}{conclusion}"));
            check.in_numbers().iter().for_each(|numbers| say(&bar, format!("- {numbers}")));
            check.missing.iter().for_each(|missing| say(&bar, format!("- missing evidence: {missing}")));
            check.warnings.iter().for_each(|text| say(&bar, format!("warning: {text}")));
            if check.faulty() {
                say(&bar, "warning: `nertca-vk check DATA` looks for the usual mistakes".into());
            }
        }
        Event::Adjusting { share } => bar.set_message(format!("adjusting views, {:.0} %", 100.0 * share)),
        Event::Preparing { share } => bar.set_message(format!("initialising Gaussians, {:.0} %", 100.0 * share)),
        Event::Progress { loss, psnr, iterations_per_s, left_s, .. } => {
            bar.set_position(u64::from(loss.step));
            // Gaussians are fitted to bounds, which have no PSNR.
            let psnr = if psnr.is_nan() { "Gaussians".into() } else { format!("PSNR {psnr:.1} dB") };
            bar.set_message(format!(
                "loss {:.3e}  {psnr}  {iterations_per_s:.1} it/s  {left_s:.0} s left",
                loss.total()
            ));
        }
        Event::LargeLoss { step, loss, ratio } => {
            say(&bar, format!("warning: {}", LargeLoss { step: *step, loss: *loss, ratio: *ratio }));
        }
        Event::Found { note, .. } => say(&bar, format!("- {note}")),
        Event::Validation { step, train_s, dice_dynamic, psnr, ssim, dynamic_integral, .. } => {
            let dice = dice_dynamic.map_or("-".into(), |d| format!("{d:.3}"));
            say(&bar, format!("{step:6} iterations, {train_s:6.1} s: Dice {dice}  PSNR {psnr:.2} dB  SSIM {ssim:.3}"));
            if !has_vanished && dynamic_integral.is_some_and(|share| share < VANISHED) {
                has_vanished = true;
                say(&bar, of_vanished(*step));
            }
        }
        Event::Evaluation { .. } => evaluation(event),
        Event::Profile { .. } => (),
        Event::Saved { path, .. } => bar.set_message(format!("saved {}", path.display())),
        Event::Finished { step, train_s, dynamic_share, agreement, .. } => {
            bar.finish_and_clear();
            say(&bar, format!("{step} iterations in {train_s:.1} s of training"));
            if let Some(share) = agreement {
                say(&bar, of_agreement(*share));
            }
            if let Some(share) = dynamic_share.filter(|share| *share > EXPLAINS_LITTLE) {
                say(
                    &bar,
                    format!(
                        "warning: with the dynamic field, {:.0} % of the loss without a dynamic field is left: the \
                         dynamic field has become zero, or the views disagree, which `nertca-vk check` tests",
                        100.0 * share
                    ),
                );
            }
        }
    }
}

/// Returns an observer that shows a bar for an evaluation, or a line for every tenth of it if stderr is not a terminal.
pub fn show_evaluation() -> impl FnMut(&Event) {
    let terminal = std::io::stderr().is_terminal();
    let mut shown = None;
    move |event| {
        let Event::Evaluation { images, of, left_s, .. } = event else { return };
        let left = left_s.map_or(String::new(), |s| format!(", {s:.0} s left"));
        if !terminal {
            let tenth = images * 10 / (*of).max(1);
            if shown.as_ref().is_none_or(|(_, last)| *last != tenth) {
                eprintln!("unseen images: {images} of {of}{left}");
                shown = Some((ProgressBar::hidden(), tenth));
            }
            return;
        }
        let (bar, _) = shown.get_or_insert_with(|| (bar("[{bar:30}] {pos}/{len} unseen images{msg}"), 0));
        bar.set_length(*of as u64);
        bar.set_position(*images as u64);
        bar.set_message(left);
        if images == of {
            bar.finish_and_clear();
        }
    }
}

/// Returns a sentence on the share of the attenuation of one fit that lies in vessels of another.
fn of_agreement(share: f64) -> String {
    let percent = 100.0 * share;
    if share >= FITS_AGREE {
        return format!("repeated fits agree: {percent:.0} % of the vessels of one lie in those of another");
    }
    format!(
        "warning: repeated fits disagree: only {percent:.0} % of the vessels of one lie in those of another, so parts of the dynamic field \
         are false; `nertca-vk check` looks for mistakes in the data, and another view or images with less noise help"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fits_that_disagree_are_a_warning() {
        assert_eq!(of_agreement(0.764), "repeated fits agree: 76 % of the vessels of one lie in those of another");
        assert!(of_agreement(0.594).starts_with("warning: repeated fits disagree: only 59 %"));
    }
}
