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
    pub(crate) fn new(stage: &'a Stage, label: &'static str, total: u64, quiet: bool, json: bool) -> Self {
        let out = if json {
            Out::Events
        } else if quiet {
            Out::Silent
        } else if std::io::stderr().is_terminal() {
            let style = ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len} {per_sec} eta {eta} {msg}")
                .unwrap_or_else(|_| ProgressStyle::default_bar());
            let bar = ProgressBar::new(total).with_style(style).with_prefix(label);
            Out::Bar(bar)
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
            Out::Lines if self.last_said.elapsed() >= LINE_EVERY => self.say_line(fields),
            Out::Events if self.last_said.elapsed() >= EVENT_EVERY => self.say_event(fields),
            Out::Lines | Out::Events => {}
        }
    }

    /// One more step is done.
    pub fn step(&mut self) {
        self.set(self.done + 1, &[]);
    }

    /// Ends the progress with a last line.
    pub fn finish(mut self, fields: &[(&str, f64)]) {
        match &self.out {
            Out::Silent => {}
            Out::Bar(bar) => {
                bar.finish_and_clear();
                self.say_line(fields);
            }
            Out::Lines => self.say_line(fields),
            Out::Events => self.say_event(fields),
        }
    }

    fn rate(&self) -> f64 {
        (self.done - self.first) as f64 / self.started.elapsed().as_secs_f64().max(1e-9)
    }

    fn eta(&self) -> Option<f64> {
        let rate = self.rate();
        (rate > 0.0).then(|| self.total.saturating_sub(self.done) as f64 / rate)
    }

    fn say_line(&mut self, fields: &[(&str, f64)]) {
        self.last_said = Instant::now();
        let eta = self.eta().map_or(String::new(), |s| format!(", eta {s:.0} s"));
        let sep = if fields.is_empty() { "" } else { ", " };
        self.stage.line(&format!(
            "{} {}/{} ({}{eta}){sep}{}",
            self.label,
            self.done,
            self.total,
            pace(self.rate()),
            text(fields)
        ));
    }

    fn say_event(&mut self, fields: &[(&str, f64)]) {
        self.last_said = Instant::now();
        let mut all = vec![
            ("label", json!(self.label)),
            ("done", json!(self.done)),
            ("total", json!(self.total)),
            ("per_second", json!(self.rate())),
            ("eta_seconds", json!(self.eta())),
        ];
        all.extend(fields.iter().map(|&(k, v)| (k, json!(v))));
        self.stage.event("progress", &all);
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
