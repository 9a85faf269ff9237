//! The models that can answer, newest last.

use crate::scheduler::{Scheduler, WeightsKey};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// Models that are kept: actors may ask for one that is no longer the latest.
const KEPT: usize = 4;

/// One version of the weights, made into a scheduler; or why that was not possible.
#[derive(Clone)]
pub(crate) struct Model {
    pub(crate) key: Arc<WeightsKey>,
    pub(crate) scheduler: Result<Arc<dyn Scheduler>, String>,
}

impl fmt::Debug for Model {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Model").field("key", &self.key).field("problem", &self.scheduler.as_ref().err()).finish()
    }
}

/// Filled by the subscription, read by requests, which may wait for a version.
#[derive(Debug)]
pub(crate) struct Store {
    models: watch::Sender<Arc<Vec<Model>>>,
}

impl Store {
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

    /// The newest model that can answer. Whoever holds it answers from this version alone, whatever comes in meanwhile.
    pub(crate) fn latest(&self) -> Option<(Arc<WeightsKey>, Arc<dyn Scheduler>)> {
        let models = self.models.borrow();
        models.iter().rev().find_map(|model| Some((model.key.clone(), model.scheduler.as_ref().ok()?.clone())))
    }

    /// The model of this name, as soon as it is here, for at most `patience`.
    pub(crate) async fn wait(&self, key: &WeightsKey, patience: Duration) -> Option<Model> {
        let mut models = self.models.subscribe();
        let find = |models: &Vec<Model>| models.iter().find(|model| *model.key == *key).cloned();
        let arrived = models.wait_for(|models| find(models).is_some());
        let models = tokio::time::timeout(patience, arrived).await.ok()?.ok()?;
        find(&models)
    }

    /// Returns once there is a model that can answer.
    pub(crate) async fn ready(&self) {
        let usable = |models: &Arc<Vec<Model>>| models.iter().any(|model| model.scheduler.is_ok());
        // The sender is ours: waiting cannot fail.
        let _ = self.models.subscribe().wait_for(usable).await.map(drop);
    }
}
