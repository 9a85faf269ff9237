//! The latest events of the run, for watchers that may connect late.

use crate::run_events::RunEvent;
use magex_proto::v1;
use magex_runtime::sync::lock;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Number of events kept for late watchers. A line of metrics has some kilobytes, so more would look like a leak in the first
/// hours of a run; metrics.jsonl has all lines.
const KEPT: usize = 256;

/// Number of events copied per lock, so that the log is locked only briefly.
const BATCH: usize = 64;

#[derive(Debug, Default)]
struct Log {
    first: u64,
    events: VecDeque<Arc<RunEvent>>,
}

/// The events of this process, bounded.
#[derive(Debug)]
pub(crate) struct Events {
    log: Mutex<Log>,
    /// Number of events so far.
    count: watch::Sender<u64>,
}

impl Events {
    pub(crate) fn new() -> Self {
        Self { log: Mutex::default(), count: watch::Sender::new(0) }
    }

    pub(crate) fn push(&self, event: RunEvent) {
        let count = {
            let mut log = lock(&self.log);
            log.events.push_back(Arc::new(event));
            if log.events.len() > KEPT {
                log.events.pop_front();
                log.first += 1;
            }
            log.first + log.events.len() as u64
        };
        self.count.send_replace(count);
    }

    /// Number of events kept.
    pub(crate) fn len(&self) -> usize {
        lock(&self.log).events.len()
    }

    /// At most [`BATCH`] events from number `from` on, with the number of the first.
    fn since(&self, from: u64) -> (u64, Vec<Arc<RunEvent>>) {
        let log = lock(&self.log);
        let start = from.max(log.first);
        let skip = (start - log.first) as usize;
        (start, log.events.iter().skip(skip).take(BATCH).cloned().collect())
    }

    /// Sends all kept events and then new ones. Ends with the run, when the learner closes, or when the reader disconnects or
    /// reads nothing for `patience`.
    pub(crate) async fn stream(
        self: Arc<Self>,
        reader: mpsc::Sender<Result<v1::WatchRunResponse, Status>>,
        closing: CancellationToken,
        patience: Duration,
    ) {
        let mut count = self.count.subscribe();
        let mut next = 0;
        loop {
            count.borrow_and_update();
            let (start, events) = self.since(next);
            if events.is_empty() {
                tokio::select! {
                    biased;
                    changed = count.changed() => if changed.is_err() { return },
                    () = reader.closed() => return,
                    () = closing.cancelled() => return,
                }
                continue;
            }
            next = start;
            for event in events {
                let finished = matches!(*event, RunEvent::Finished { .. });
                let message = v1::WatchRunResponse { sequence: next, event: Some(to_message(&event)) };
                match reader.send_timeout(Ok(message), patience).await {
                    Ok(()) if !finished => {}
                    Ok(()) | Err(mpsc::error::SendTimeoutError::Closed(_)) => return,
                    Err(mpsc::error::SendTimeoutError::Timeout(_)) => {
                        tracing::warn!(?patience, "a watcher of the run reads nothing; ending its stream");
                        return;
                    }
                }
                next += 1;
            }
        }
    }
}

fn to_message(event: &RunEvent) -> v1::watch_run_response::Event {
    use v1::watch_run_response::Event;
    match event {
        RunEvent::Iteration(report) => Event::Iteration(v1::IterationEvent {
            iteration: report.iteration.0,
            joint_env_steps: report.joint_env_steps,
            success: report.success,
            reward: report.reward,
            metrics_json: report.metrics_json.clone(),
        }),
        RunEvent::Log(text) => Event::Log(text.clone()),
        RunEvent::Checkpoint { iteration, path } => {
            Event::Checkpoint(v1::CheckpointEvent { iteration: iteration.0, path: path.clone() })
        }
        RunEvent::Finished { summary_json } => {
            Event::Finished(v1::FinishedEvent { summary_json: summary_json.clone() })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_late_watcher_receives_the_kept_events_and_the_end() {
        let events = Arc::new(Events::new());
        for i in 0..KEPT + 5 {
            events.push(RunEvent::Log(i.to_string()));
        }
        let (tx, mut rx) = mpsc::channel(4);
        tokio::spawn(events.clone().stream(tx, CancellationToken::new(), Duration::from_secs(60)));
        for i in 5..KEPT + 5 {
            let got = rx.recv().await.unwrap().unwrap();
            assert_eq!(got.sequence, i as u64);
            assert_eq!(got.event, Some(v1::watch_run_response::Event::Log(i.to_string())));
        }
        events.push(RunEvent::Finished { summary_json: "{}".into() });
        assert!(matches!(rx.recv().await.unwrap().unwrap().event, Some(v1::watch_run_response::Event::Finished(_))));
        assert!(rx.recv().await.is_none());
    }

    #[tokio::test]
    async fn the_stream_of_a_watcher_that_reads_nothing_ends() {
        let events = Arc::new(Events::new());
        (0..9).for_each(|i| events.push(RunEvent::Log(i.to_string())));
        let (tx, mut rx) = mpsc::channel(4);
        events.stream(tx, CancellationToken::new(), Duration::from_millis(20)).await;
        for i in 0..4 {
            assert_eq!(rx.recv().await.unwrap().unwrap().sequence, i);
        }
        assert!(rx.recv().await.is_none());
    }
}
