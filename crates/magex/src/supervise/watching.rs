//! What the learner reports: events of the run, and how far its iteration is.

use crate::progress::LiveLine;
use magex_learner::run_events::RunEvent;
use magex_proto::v1;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_runtime::client;
use std::time::Duration;
use tokio::sync::mpsc;
use tonic::transport::Channel;

/// How often the status line follows the shards of an iteration.
const SHARDS_EVERY: Duration = Duration::from_millis(250);

/// A restarted learner and a reconnected stream repeat iterations that were shown before.
pub(super) fn is_new(event: &RunEvent, shown: &mut Option<u32>) -> bool {
    let RunEvent::Iteration(report) = event else { return true };
    let new = Some(report.iteration) > *shown;
    *shown = (*shown).max(Some(report.iteration));
    new
}

/// Follows the events of the run, across restarts of the learner.
pub(super) async fn watch(url: String, events: mpsc::Sender<RunEvent>) {
    while !events.is_closed() {
        if let Err(error) = follow(&url, &events).await {
            tracing::debug!("the learner's events: {error:#}");
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

async fn follow(url: &str, events: &mpsc::Sender<RunEvent>) -> anyhow::Result<()> {
    let mut client = LearnerServiceClient::new(client::endpoint(url)?.connect().await?);
    let opened = tokio::time::timeout(Duration::from_secs(10), client.watch_run(v1::WatchRunRequest {})).await;
    let mut stream = opened??.into_inner();
    while let Some(message) = stream.message().await? {
        if let Some(event) = message.event {
            events.send(event).await?;
        }
    }
    Ok(())
}

/// Shows in the status line how far the iteration is.
pub(super) async fn show_shards(url: String, live: LiveLine) {
    let mut client = None;
    loop {
        tokio::time::sleep(SHARDS_EVERY).await;
        let status = match shards(&url, &mut client).await {
            Ok(status) => status,
            // It restarts: the line keeps its words until it answers.
            Err(_) => {
                client = None;
                continue;
            }
        };
        match status.state() {
            v1::RunState::Collecting | v1::RunState::Evaluating => {
                live.shards(status.shards_done.into(), status.shards_total.into());
            }
            v1::RunState::Training => live.doing("updating"),
            v1::RunState::WaitingForActors => live.doing("waiting for actors"),
            _ => {}
        }
    }
}

async fn shards(url: &str, client: &mut Option<LearnerServiceClient<Channel>>) -> anyhow::Result<v1::RunStatus> {
    let connected = match client {
        Some(connected) => connected,
        None => client.insert(LearnerServiceClient::new(client::endpoint(url)?.connect().await?)),
    };
    let run = tokio::time::timeout(Duration::from_secs(3), connected.get_run(v1::GetRunRequest {})).await??;
    Ok(run.into_inner().run.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(iteration: u32) -> RunEvent {
        RunEvent::Iteration(v1::IterationEvent { iteration, ..Default::default() })
    }

    #[test]
    fn iterations_that_are_done_again_are_shown_once() {
        let mut shown = None;
        let new = [0, 1, 0, 1, 2, 3, 3].map(|iteration| is_new(&event(iteration), &mut shown));
        assert_eq!(new, [true, true, false, false, true, true, false]);
    }
}
