//! Progress of long work: a bar on a terminal, plain lines in a log, JSON lines for programs.

use crate::Stage;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

/// Seconds between two lines in a log.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Seconds between two JSON events.
const EVENT_EVERY: Duration = Duration::from_secs(1);

/// Progress over a known number of steps, with rate and estimated time left.
pub struct Progress<'a> {
    stage: &'a Stage,
    label: &'static str,
    total: u64,
    done: u64,
    first: u64,
    started: Instant,
    last_said: Instant,
    out: Out,
}

enum Out {
    Silent,
    Bar(ProgressBar),
    Lines,
    Events,
}

impl<'a> Progress<'a> {
    pub(crate) fn new(stage: &'a Stage, label: &'static str, total: u64) -> Self {
        let out = if stage.common.json {
            Out::Events
        } else if stage.common.quiet {
            Out::Silent
        } else if std::io::stderr().is_terminal() {
            let style = ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len} {per_sec} eta {eta} {msg}")
                .unwrap_or_else(|_| ProgressStyle::default_bar());
            Out::Bar(ProgressBar::new(total).with_style(style).with_prefix(label))
        } else {
            Out::Lines
        };
        let now = Instant::now();
        Self { stage, label, total, done: 0, first: 0, started: now, last_said: now, out }
    }

    /// Starts at `done` instead of 0: work that an earlier run did, which does not count for the rate.
    #[must_use]
    pub fn resumed_at(mut self, done: u64) -> Self {
        self.done = done;
        self.first = done;
        if let Out::Bar(bar) = &self.out {
            bar.set_position(done);
            bar.reset_eta();
        }
        self
    }

    /// Says that `done` steps are done in all; `fields` are figures worth seeing, such as the loss.
    pub fn set(&mut self, done: u64, fields: &[(&str, f64)]) {
        self.done = done;
        match &self.out {
            Out::Silent => {}
            Out::Bar(bar) => {
                bar.set_position(done);
                bar.set_message(text(fields));
            }
            Out::Lines if self.last_said.elapsed() >= LINE_EVERY => self.say(fields),
            Out::Events if self.last_said.elapsed() >= EVENT_EVERY => self.say(fields),
            Out::Lines | Out::Events => {}
        }
    }

    /// One more step is done.
    pub fn step(&mut self) {
        self.set(self.done + 1, &[]);
    }

    /// Ends the progress with a last line.
    pub fn finish(mut self, fields: &[(&str, f64)]) {
        if let Out::Bar(bar) = &self.out {
            bar.finish_and_clear();
        }
        self.say(fields);
    }

    /// A line, or an event.
    fn say(&mut self, fields: &[(&str, f64)]) {
        self.last_said = Instant::now();
        let Self { label, total, done, .. } = *self;
        let rate = (done - self.first) as f64 / self.started.elapsed().as_secs_f64().max(1e-9);
        let eta = (rate > 0.0).then(|| total.saturating_sub(done) as f64 / rate);
        match &self.out {
            Out::Silent => {}
            Out::Events => {
                let mut all = vec![("label", json!(label)), ("done", json!(done)), ("total", json!(total))];
                all.extend([("per_second", json!(rate)), ("eta_seconds", json!(eta))]);
                all.extend(fields.iter().map(|&(k, v)| (k, json!(v))));
                self.stage.event("progress", &all);
            }
            Out::Bar(_) | Out::Lines => {
                let eta = eta.map_or(String::new(), |s| format!(", eta {s:.0} s"));
                let sep = if fields.is_empty() { "" } else { ", " };
                self.stage.line(&format!("{label} {done}/{total} ({}{eta}){sep}{}", pace(rate), text(fields)));
            }
        }
    }
}

/// Steps per second, or seconds per step where those are more than one.
fn pace(rate: f64) -> String {
    if rate > 0.0 && rate < 1.0 { format!("{:.1} s each", 1.0 / rate) } else { format!("{rate:.1}/s") }
}

fn text(fields: &[(&str, f64)]) -> String {
    let parts: Vec<String> = fields
        .iter()
        .map(|(k, v)| if v.fract() == 0.0 && v.abs() < 1e12 { format!("{k} {v:.0}") } else { format!("{k} {v:.4}") })
        .collect();
    parts.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slow_work_is_told_in_seconds_each() {
        assert_eq!(
            (pace(0.0), pace(0.05), pace(1.0), pace(12.34)),
            ("0.0/s".into(), "20.0 s each".into(), "1.0/s".into(), "12.3/s".into())
        );
    }
}
