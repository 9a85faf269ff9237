//! The latest events of the run, for watchers that may connect late.

use crate::run_events::RunEvent;
use crate::serve::patience;
use magex_proto::v1;
use magex_runtime::net::heartbeat::Heartbeat;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// Number of events kept for late watchers. A line of metrics has some kilobytes, so more would look like a leak in the first
/// hours of a run; metrics.jsonl has all lines.
const KEPT: usize = 256;

#[derive(Debug, Default)]
struct Log {
    /// Number of the first event kept.
    first: u64,
    events: VecDeque<Arc<RunEvent>>,
}

impl Log {
    /// The kept events from number `from` on, with the number of the first.
    fn since(&self, from: u64) -> (u64, Vec<Arc<RunEvent>>) {
        let start = from.max(self.first);
        (start, self.events.iter().skip((start - self.first) as usize).cloned().collect())
    }
}

/// The events of this process, bounded.
#[derive(Debug, Default)]
pub(crate) struct Events(watch::Sender<Log>);

impl Events {
    pub(crate) fn push(&self, event: RunEvent) {
        self.0.send_modify(|log| {
            log.events.push_back(Arc::new(event));
            if log.events.len() > KEPT {
                log.events.pop_front();
                log.first += 1;
            }
        });
    }

    pub(crate) fn len(&self) -> usize {
        self.0.borrow().events.len()
    }

    /// Sends all kept events and then new ones. Ends with the run, when the learner closes, or when the reader disconnects or
    /// reads nothing for `patience`.
    pub(crate) async fn stream(
        self: Arc<Self>,
        reader: mpsc::Sender<Result<v1::WatchRunResponse, Status>>,
        closing: CancellationToken,
        patience: Duration,
        mut heartbeat: Heartbeat,
    ) {
        let mut log = self.0.subscribe();
        let mut next = 0;
        loop {
            let (start, events) = log.borrow_and_update().since(next);
            if events.is_empty() {
                tokio::select! {
                    biased;
                    changed = log.changed() => if changed.is_err() { return },
                    () = reader.closed() => return,
                    () = closing.cancelled() => return,
                    () = heartbeat.due() => {
                        // A queue with messages in it needs no heartbeat.
                        let _ = reader.try_send(Ok(v1::WatchRunResponse { sequence: next, event: None }));
                    }
                }
                continue;
            }
            next = start;
            for event in events {
                let message = v1::WatchRunResponse { sequence: next, event: Some((*event).clone()) };
                let sent = patience::send(&reader, message, patience, "a watcher of the run").await;
                if !sent || matches!(*event, RunEvent::Finished(_)) {
                    return;
                }
                next += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_late_watcher_receives_the_kept_events_and_the_end() {
        let events = Arc::new(Events::default());
        for i in 0..KEPT + 5 {
            events.push(RunEvent::Log(i.to_string()));
        }
        let (tx, mut rx) = mpsc::channel(4);
        tokio::spawn(events.clone().stream(
            tx,
            CancellationToken::new(),
            Duration::from_secs(60),
            Heartbeat::new(None),
        ));
        for i in 5..KEPT + 5 {
            let got = rx.recv().await.unwrap().unwrap();
            assert_eq!(got.sequence, i as u64);
            assert_eq!(got.event, Some(v1::watch_run_response::Event::Log(i.to_string())));
        }
        events.push(RunEvent::Finished(v1::FinishedEvent { summary_json: "{}".into() }));
        assert!(matches!(rx.recv().await.unwrap().unwrap().event, Some(v1::watch_run_response::Event::Finished(_))));
        assert!(rx.recv().await.is_none());
    }

    #[tokio::test]
    async fn the_stream_of_a_watcher_that_reads_nothing_ends() {
        let events = Arc::new(Events::default());
        (0..9).for_each(|i| events.push(RunEvent::Log(i.to_string())));
        let (tx, mut rx) = mpsc::channel(4);
        events.stream(tx, CancellationToken::new(), Duration::from_millis(20), Heartbeat::new(None)).await;
        for i in 0..4 {
            assert_eq!(rx.recv().await.unwrap().unwrap().sequence, i);
        }
        assert!(rx.recv().await.is_none());
    }
}
