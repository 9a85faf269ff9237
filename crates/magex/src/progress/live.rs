//! The status line: how much of the budget is done, which shards of the iteration, and how long the rest may take.

use super::columns::USUAL_WIDTH;
use crate::logging::set_live_line;
use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use magex_runtime::sync::lock;
use rustix::termios::tcgetwinsize;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// A handle: clones show the same line.
#[derive(Debug, Clone)]
pub(crate) struct LiveLine {
    bar: ProgressBar,
    place: Arc<Mutex<Place>>,
}

#[derive(Debug)]
struct Place {
    max_steps: u64,
    steps_per_iteration: u64,
    /// Iterations and joint steps that are complete.
    completed: (u32, u64),
    /// Whether the run trains no more.
    over: bool,
    /// Words that stay.
    kept: bool,
    /// When this process reported its first iteration, and the joint steps that were done then.
    first: Option<(Instant, u64)>,
}

impl LiveLine {
    pub(super) fn start(max_steps: u64, steps_per_iteration: u64) -> Self {
        let bar = ProgressBar::with_draw_target(Some(max_steps), ProgressDrawTarget::stderr_with_hz(10));
        let place = Place { max_steps, steps_per_iteration, completed: (0, 0), over: false, kept: false, first: None };
        let live = Self { bar, place: Arc::new(Mutex::new(place)) };
        let template = match live.width() {
            0..USUAL_WIDTH => "{spinner:.cyan} {percent} % · {msg} · {elapsed}{prefix}",
            _ => "{spinner:.cyan} {bar:6.cyan/dim} {human_pos}/{human_len} steps · {msg} · {elapsed}{prefix}",
        };
        if let Ok(style) = ProgressStyle::with_template(template) {
            live.bar.set_style(style.progress_chars("━━─"));
        }
        live.bar.set_message("starting");
        live.bar.enable_steady_tick(Duration::from_millis(100));
        set_live_line(Some(live.bar.clone()));
        live
    }

    /// Of the terminal, in characters.
    pub(super) fn width(&self) -> usize {
        let size = tcgetwinsize(std::io::stderr());
        size.ok().map(|size| usize::from(size.ws_col)).filter(|&width| width > 0).unwrap_or(USUAL_WIDTH)
    }

    /// An iteration was reported: so many iterations and joint steps are complete. `over` if it was the last.
    pub(super) fn iteration(&self, iterations: u32, steps: u64, over: bool) {
        let mut place = lock(&self.place);
        (place.completed, place.over) = ((iterations, steps), over);
        let (begun, from) = *place.first.get_or_insert((Instant::now(), steps));
        let done = steps.saturating_sub(from);
        let left = place.max_steps.saturating_sub(steps);
        let prefix = match (done, left) {
            (1.., 1..) if !over => {
                let left = begun.elapsed().mul_f64(left as f64 / done as f64);
                // The target may be reached before the budget is spent.
                format!(" · ≤ {:#} left", HumanDuration(left))
            }
            _ => String::new(),
        };
        self.bar.set_prefix(prefix);
        drop(place);
        self.shards(0, 0);
    }

    /// So many of the iteration's shards have arrived; 0 of 0 while it is unknown.
    pub(crate) fn shards(&self, done: u64, total: u64) {
        let place = lock(&self.place);
        let (iteration, steps) = place.completed;
        let training = !place.over && steps < place.max_steps;
        let within = if training && total > 0 { place.steps_per_iteration * done / total } else { 0 };
        self.bar.set_position(steps + within);
        let what = if place.over { "closing evaluation".to_owned() } else { format!("iteration {iteration}") };
        self.say(&place, if total > 0 { format!("{what}: {done}/{total} shards") } else { what });
    }

    /// The learner does something else than collecting.
    pub(crate) fn doing(&self, what: &str) {
        let place = lock(&self.place);
        if !place.over {
            self.say(&place, format!("iteration {}: {what}", place.completed.0));
        }
    }

    pub(super) fn keep(&self, text: &str) {
        lock(&self.place).kept = true;
        self.bar.set_message(text.to_owned());
    }

    fn say(&self, place: &Place, text: String) {
        if !place.kept {
            self.bar.set_message(text);
        }
    }

    pub(super) fn end(&self) {
        set_live_line(None);
        self.bar.finish_and_clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_moves_within_an_iteration_and_tells_the_time_left() {
        let live = LiveLine::start(10_000, 1_000);
        live.bar.set_draw_target(ProgressDrawTarget::hidden());
        live.shards(2, 8);
        assert_eq!((live.bar.position(), live.bar.message().as_str()), (250, "iteration 0: 2/8 shards"));
        live.doing("updating");
        assert_eq!(live.bar.message(), "iteration 0: updating");
        live.iteration(1, 1_000, false);
        assert_eq!((live.bar.position(), live.bar.prefix().as_str()), (1_000, ""));
        live.iteration(2, 2_000, false);
        assert!(live.bar.prefix().starts_with(" · ≤ ") && live.bar.prefix().ends_with(" left"));
        live.iteration(2, 2_000, true);
        live.shards(7, 14);
        assert_eq!((live.bar.position(), live.bar.message().as_str()), (2_000, "closing evaluation: 7/14 shards"));
        live.keep("finished");
        live.shards(14, 14);
        assert_eq!((live.bar.message().as_str(), live.bar.prefix().as_str()), ("finished", ""));
    }
}
