//! Times and losses from a run's log. An interrupted run has several parts, each with its own clock.

use serde_json::Value;
use std::path::Path;

/// Times and losses of a run.
#[derive(Debug, Default, PartialEq)]
pub struct History {
    /// Seconds of training over all parts.
    pub train_s: f64,
    /// Seconds of all parts but the last, including validation and saving.
    pub before_s: f64,
    /// Number of parts.
    pub parts: u32,
    /// Validations during training.
    pub curve: Vec<Validated>,
    /// Losses during training.
    pub losses: Vec<Losses>,
}

/// One validation during training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Validated {
    /// Iterations done.
    pub step: u32,
    /// Seconds of training until then, over all parts.
    pub train_s: f64,
    /// Dice of the dynamic field, where images have masks.
    pub dice: Option<f64>,
    /// Dice of both fields.
    pub dice_total: Option<f64>,
    /// Structural similarity.
    pub ssim: Option<f64>,
    /// Distance to the true vessels at one phase, mm.
    pub chamfer_mm: Option<f64>,
}

/// Losses of an iteration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Losses {
    /// Seconds until then, over all parts, including validation and saving.
    pub elapsed_s: f64,
    /// Data term of the loss.
    pub data: Option<f64>,
    /// Data term of the dynamic field.
    pub dynamic: Option<f64>,
}

/// Times of one part, as far as its lines state them.
#[derive(Default)]
struct PartTimes {
    elapsed_s: f64,
    /// Seconds of training only, if the part was completed.
    train_s: Option<f64>,
}

impl PartTimes {
    fn train_s(&self) -> f64 {
        self.train_s.unwrap_or(self.elapsed_s)
    }
}

impl History {
    /// Reads the log of a run; an empty history where there is none.
    pub fn read(run: &Path) -> History {
        History::of(&std::fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default())
    }

    fn of(log: &str) -> History {
        let (mut history, mut part) = (History::default(), PartTimes::default());
        for line in log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok()) {
            let number = |key: &str| line[key].as_f64();
            part.elapsed_s = number("elapsed_s").unwrap_or(part.elapsed_s);
            match line["event"].as_str() {
                Some("started") => {
                    history.train_s += part.train_s();
                    history.before_s += part.elapsed_s;
                    history.parts += 1;
                    part = PartTimes::default();
                }
                Some("finished") => part.train_s = number("train_s"),
                Some("validation") => history.curve.push(Validated {
                    step: line["step"].as_u64().unwrap_or_default() as u32,
                    train_s: history.train_s + number("train_s").unwrap_or_default(),
                    dice: number("dice_dynamic"),
                    dice_total: number("dice_total"),
                    ssim: number("ssim"),
                    chamfer_mm: number("chamfer_mm"),
                }),
                Some("progress") => history.losses.push(Losses {
                    elapsed_s: history.before_s + part.elapsed_s,
                    data: number("data"),
                    dynamic: number("dynamic"),
                }),
                _ => (),
            }
        }
        history.train_s += part.train_s();
        history
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_add_up() {
        let log = r#"{"event":"started","step":0}
            {"event":"progress","step":10,"elapsed_s":2.0}
            {"event":"validation","step":10,"train_s":1.5,"dice_dynamic":0.5,"chamfer_mm":2.5}
            {"event":"progress","step":20,"elapsed_s":4.0}
            {"event":"started","step":20}
            {"event":"progress","step":30,"elapsed_s":1.0,"data":0.25}
            {"event":"started","step":30}
            {"event":"validation","step":40,"train_s":0.75,"dice_dynamic":null}
            {"event":"finished","step":40,"train_s":0.8,"elapsed_s":1.5}"#;
        let history = History::of(log);
        assert_eq!((history.train_s, history.before_s, history.parts), (5.8, 5.0, 3));
        let curve: Vec<_> = history.curve.iter().map(|p| (p.step, p.train_s, p.dice, p.chamfer_mm)).collect();
        assert_eq!(curve, [(10, 1.5, Some(0.5), Some(2.5)), (40, 5.75, None, None)]);
        let losses: Vec<_> = history.losses.iter().map(|l| (l.elapsed_s, l.data)).collect();
        assert_eq!(losses, [(2.0, None), (4.0, None), (5.0, Some(0.25))]);
        assert_eq!(History::of(""), History::default());
    }
}
