//! Publication of the weights: immutable versions, of which the latest two are kept; slow subscribers skip versions.

use crate::serve::patience;
use magex_core::ids::WeightsVersion;
use magex_proto::v1::WatchWeightsResponse;
pub use magex_proto::weights::Weights;
use magex_runtime::net::heartbeat::Heartbeat;
use magex_runtime::sync::lock;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};
use tonic::Status;

/// Number of versions kept: with a policy lag of 1 shards name the version before the latest.
const KEPT: usize = 2;

/// Number of hashes remembered, so that late results can be checked.
const REMEMBERED: usize = 64;

type Snapshot = Arc<Vec<Arc<Weights>>>;

/// The trainer publishes versions here; subscribers follow them.
#[derive(Debug, Default)]
pub(crate) struct WeightsBoard {
    /// The latest versions, newest last.
    kept: watch::Sender<Snapshot>,
    /// Their hashes, and when they were published.
    published: Mutex<BTreeMap<WeightsVersion, (String, Instant)>>,
    /// Hashes of versions that other weights have replaced, newest last.
    withdrawn: Mutex<VecDeque<String>>,
}

impl WeightsBoard {
    /// Makes a version the latest and drops versions that are not older (the learner went back to an earlier checkpoint).
    pub(crate) fn publish(&self, weights: Arc<Weights>) {
        let mut published = lock(&self.published);
        // Those after it belong to what is being undone.
        let undone: Vec<WeightsVersion> = published.range(weights.version..).map(|(version, _)| *version).collect();
        for (old, _) in undone.iter().filter_map(|version| published.remove(version)) {
            if old != weights.sha256 {
                let mut withdrawn = lock(&self.withdrawn);
                withdrawn.push_back(old);
                let surplus = withdrawn.len().saturating_sub(REMEMBERED);
                withdrawn.drain(..surplus);
            }
        }
        published.insert(weights.version, (weights.sha256.clone(), Instant::now()));
        while published.len() > REMEMBERED {
            published.pop_first();
        }
        drop(published);
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

    pub(crate) async fn first(&self) {
        // This struct owns the sender, so the wait cannot fail.
        let _ = self.kept.subscribe().wait_for(|kept| !kept.is_empty()).await.map(drop);
    }

    pub(crate) fn kept(&self, version: WeightsVersion) -> Option<Arc<Weights>> {
        self.kept.borrow().iter().find(|weights| weights.version == version).cloned()
    }

    pub(crate) fn is_kept(&self, version: WeightsVersion) -> bool {
        self.kept(version).is_some()
    }

    /// Whether weights of this hash were replaced by others of the same version: the learner went back to a checkpoint.
    pub(crate) fn is_withdrawn(&self, sha256: &str) -> bool {
        lock(&self.withdrawn).iter().any(|other| other == sha256)
    }

    pub(crate) fn sha256(&self, version: WeightsVersion) -> Option<String> {
        lock(&self.published).get(&version).map(|published| published.0.clone())
    }

    pub(crate) fn since(&self, version: WeightsVersion) -> Option<Instant> {
        lock(&self.published).get(&version).map(|published| published.1)
    }

    pub(crate) fn subscribe(&self) -> watch::Receiver<Snapshot> {
        self.kept.subscribe()
    }
}

/// Sends the kept versions and then every newer one, each whole, until the reader disconnects or reads nothing for
/// `patience`. A slow reader skips versions that were replaced in the meantime. `sent_newer` is called after every version
/// that the reader had been waiting for.
pub(crate) async fn stream(
    mut board: watch::Receiver<Snapshot>,
    run_config_toml: String,
    reader: mpsc::Sender<Result<WatchWeightsResponse, Status>>,
    patience: Duration,
    mut heartbeat: Heartbeat,
    sent_newer: impl Fn(WeightsVersion),
) {
    let mut sent: Option<Arc<Weights>> = None;
    loop {
        let next = next_version(&board.borrow_and_update(), sent.as_ref());
        match next {
            Some(weights) => {
                for message in weights.messages(&run_config_toml) {
                    if !patience::send(&reader, message, patience, "a subscriber of the weights").await {
                        return;
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
                () = heartbeat.due() => {
                    // A queue with messages in it needs no heartbeat.
                    let _ = reader.try_send(Ok(WatchWeightsResponse::default()));
                }
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

    fn published(versions: impl IntoIterator<Item = u32>) -> WeightsBoard {
        let board = WeightsBoard::default();
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
        tokio::spawn(stream(
            board.subscribe(),
            String::new(),
            tx,
            Duration::from_secs(60),
            Heartbeat::new(None),
            |_| (),
        ));
        assert_eq!(rx.recv().await.unwrap().unwrap().version, 1);
        (2..=100).for_each(|version| board.publish(weights(version)));
        let mut seen = vec![];
        while seen.last() != Some(&100) {
            seen.push(rx.recv().await.unwrap().unwrap().version);
        }
        assert!(seen.len() <= 4 && seen.is_sorted(), "{seen:?}");
    }

    #[tokio::test]
    async fn the_stream_of_a_reader_that_reads_nothing_ends() {
        let board = published([1, 2]);
        let (tx, mut rx) = mpsc::channel(1);
        // The channel has no room for the second version.
        stream(board.subscribe(), String::new(), tx, Duration::from_millis(20), Heartbeat::new(None), |_| ()).await;
        assert_eq!(rx.recv().await.unwrap().unwrap().version, 1);
        assert!(rx.recv().await.is_none());
    }
}
