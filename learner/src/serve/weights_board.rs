//! Publication of the weights: immutable versions, the latest two kept, slow subscribers skip.

use magex_core::ids::WeightsVersion;
use magex_proto::v1::WatchWeightsResponse;
pub use magex_proto::weights::Weights;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};
use tonic::Status;

use magex_runtime::sync::lock;

/// Versions that are kept: with a policy lag of 1 shards name the version before the latest.
const KEPT: usize = 2;

/// Hashes that are remembered, so that a late result can still be checked.
const REMEMBERED: usize = 64;

type Snapshot = Arc<Vec<Arc<Weights>>>;

/// Where the trainer pins up what it made and subscribers read it.
#[derive(Debug)]
pub(crate) struct Board {
    /// The latest versions, newest last.
    kept: watch::Sender<Snapshot>,
    /// Their hashes, and when they were published.
    published: Mutex<BTreeMap<WeightsVersion, (String, Instant)>>,
}

impl Board {
    pub(crate) fn new() -> Self {
        Self { kept: watch::Sender::new(Snapshot::default()), published: Mutex::default() }
    }

    /// Makes a version the latest. One that is not newer than the latest begins anew (a learner that went back).
    pub(crate) fn publish(&self, weights: Arc<Weights>) {
        {
            let mut published = lock(&self.published);
            published.insert(weights.version, (weights.sha256.clone(), Instant::now()));
            while published.len() > REMEMBERED {
                published.pop_first();
            }
        }
        self.kept.send_modify(|kept| {
            let older = kept.iter().filter(|old| old.version < weights.version).cloned();
            let mut now: Vec<Arc<Weights>> = older.collect();
            now.push(weights);
            let surplus = now.len().saturating_sub(KEPT);
            *kept = Arc::new(now.split_off(surplus));
        });
    }

    pub(crate) fn latest(&self) -> Option<Arc<Weights>> {
        self.kept.borrow().last().cloned()
    }

    /// Returns once there is a version.
    pub(crate) async fn first(&self) {
        // The sender is ours: waiting cannot fail.
        let _ = self.kept.subscribe().wait_for(|kept| !kept.is_empty()).await.map(drop);
    }

    /// A version that can still be had.
    pub(crate) fn is_kept(&self, version: WeightsVersion) -> bool {
        self.kept.borrow().iter().any(|weights| weights.version == version)
    }

    pub(crate) fn sha256(&self, version: WeightsVersion) -> Option<String> {
        lock(&self.published).get(&version).map(|published| published.0.clone())
    }

    /// When a version was published.
    pub(crate) fn since(&self, version: WeightsVersion) -> Option<Instant> {
        lock(&self.published).get(&version).map(|published| published.1)
    }

    pub(crate) fn subscribe(&self) -> watch::Receiver<Snapshot> {
        self.kept.subscribe()
    }
}

/// Sends what is kept and then every newer version, each whole, until the reader leaves or takes nothing for as long as
/// `patience`. Versions that are replaced while the reader is slow are never sent. `sent_newer` is told of every version that
/// the reader was waiting for.
pub(crate) async fn stream(
    mut board: watch::Receiver<Snapshot>,
    run_config_toml: String,
    reader: mpsc::Sender<Result<WatchWeightsResponse, Status>>,
    patience: Duration,
    sent_newer: impl Fn(WeightsVersion),
) {
    let mut sent: Option<Arc<Weights>> = None;
    loop {
        let next = {
            let kept = board.borrow_and_update();
            next_version(&kept, sent.as_ref())
        };
        match next {
            Some(weights) => {
                for message in weights.messages(&run_config_toml) {
                    match reader.send_timeout(Ok(message), patience).await {
                        Ok(()) => {}
                        Err(mpsc::error::SendTimeoutError::Closed(_)) => return,
                        Err(mpsc::error::SendTimeoutError::Timeout(_)) => {
                            tracing::warn!(?patience, "a subscriber of the weights reads nothing; its stream ends");
                            return;
                        }
                    }
                }
                if sent.is_some() {
                    sent_newer(weights.version);
                }
                sent = Some(weights);
            }
            None => tokio::select! {
                changed = board.changed() => if changed.is_err() { return },
                () = reader.closed() => return,
            },
        }
    }
}

/// What to send after `sent`: the oldest kept version that is newer, or all of them when versions went back.
fn next_version(kept: &[Arc<Weights>], sent: Option<&Arc<Weights>>) -> Option<Arc<Weights>> {
    let latest = kept.last()?;
    match sent {
        Some(sent) if Arc::ptr_eq(sent, latest) => None,
        Some(sent) if sent.version < latest.version => kept.iter().find(|w| w.version > sent.version).cloned(),
        Some(_) => Some(latest.clone()),
        None => kept.first().cloned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytes::Bytes;
    use magex_core::ids::RunId;

    fn weights(version: u32) -> Arc<Weights> {
        let bytes = Bytes::from(version.to_le_bytes().to_vec());
        Arc::new(Weights::new(RunId("r".into()), WeightsVersion(version), bytes))
    }

    fn published(versions: impl IntoIterator<Item = u32>) -> Board {
        let board = Board::new();
        versions.into_iter().for_each(|version| board.publish(weights(version)));
        board
    }

    #[test]
    fn the_latest_two_are_kept_and_hashes_outlive_them() {
        let board = published(0..5);
        assert_eq!(board.latest().unwrap().version, WeightsVersion(4));
        assert!(board.is_kept(WeightsVersion(3)) && !board.is_kept(WeightsVersion(2)));
        assert_eq!(board.sha256(WeightsVersion(1)), Some(weights(1).sha256.clone()));
        assert_eq!(board.sha256(WeightsVersion(9)), None);
        board.publish(weights(2));
        assert_eq!(board.latest().unwrap().version, WeightsVersion(2));
        assert!(!board.is_kept(WeightsVersion(4)));
    }

    #[tokio::test]
    async fn a_slow_reader_skips_to_the_latest_two() {
        let board = published([1]);
        let (tx, mut rx) = mpsc::channel(1);
        tokio::spawn(stream(board.subscribe(), String::new(), tx, Duration::from_secs(60), |_| ()));
        assert_eq!(rx.recv().await.unwrap().unwrap().version, 1);
        (2..=100).for_each(|version| board.publish(weights(version)));
        let mut seen = vec![];
        while seen.last() != Some(&100) {
            seen.push(rx.recv().await.unwrap().unwrap().version);
        }
        assert!(seen.len() <= 4 && seen.is_sorted(), "{seen:?}");
    }

    #[tokio::test]
    async fn a_reader_that_takes_nothing_is_let_go_of() {
        let board = published([1, 2]);
        let (tx, mut rx) = mpsc::channel(1);
        // The second version finds no room.
        stream(board.subscribe(), String::new(), tx, Duration::from_millis(20), |_| ()).await;
        assert_eq!(rx.recv().await.unwrap().unwrap().version, 1);
        assert!(rx.recv().await.is_none());
    }
}
