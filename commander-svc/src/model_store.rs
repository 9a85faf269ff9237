//! The models in memory, newest last.

use crate::scheduler::{Scheduler, WeightsKey};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// Models in memory: actors may request one that is no longer the latest.
const KEPT: usize = 4;

/// The scheduler of one version of the weights, or why the weights are unusable.
#[derive(Clone)]
pub(crate) struct Model {
    pub(crate) key: Arc<WeightsKey>,
    pub(crate) scheduler: Result<Arc<dyn Scheduler>, String>,
}

/// Filled by the subscription or the weights file; requests read it and may wait for a version.
pub(crate) struct ModelStore {
    models: watch::Sender<Arc<Vec<Model>>>,
}

impl ModelStore {
    pub(crate) fn new() -> Self {
        Self { models: watch::Sender::new(Arc::default()) }
    }

    pub(crate) fn insert(&self, model: Model) {
        self.models.send_modify(|models| {
            let mut now: Vec<Model> = models.iter().filter(|old| old.key != model.key).cloned().collect();
            now.push(model);
            let surplus = now.len().saturating_sub(KEPT);
            *models = Arc::new(now.split_off(surplus));
        });
    }

    /// The newest usable model. A request that holds it answers from this version only.
    pub(crate) fn latest(&self) -> Option<(Arc<WeightsKey>, Arc<dyn Scheduler>)> {
        let models = self.models.borrow();
        models.iter().rev().find_map(|model| Some((model.key.clone(), model.scheduler.as_ref().ok()?.clone())))
    }

    /// Waits at most `timeout` for the model of this key.
    pub(crate) async fn wait(&self, key: &WeightsKey, timeout: Duration) -> Option<Model> {
        let mut models = self.models.subscribe();
        let find = |models: &Vec<Model>| models.iter().find(|model| *model.key == *key).cloned();
        let arrived = models.wait_for(|models| find(models).is_some());
        let models = tokio::time::timeout(timeout, arrived).await.ok()?.ok()?;
        find(&models)
    }

    /// Waits for a usable model.
    pub(crate) async fn ready(&self) {
        let usable = |models: &Arc<Vec<Model>>| models.iter().any(|model| model.scheduler.is_ok());
        // Cannot fail: `self` owns the sender.
        let _ = self.models.subscribe().wait_for(usable).await.map(drop);
    }
}
