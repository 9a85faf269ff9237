//! Weights from a run folder or a file, and again whenever the file is replaced.

use crate::scheduler::{LoadScheduler, WeightsKey};
use crate::store::{Model, Store};
use magex_core::ids::{RunId, WeightsVersion};
use magex_proto::weights::sha256_hex;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

/// How often the file is looked at.
const INTERVAL: Duration = Duration::from_secs(1);

/// Names in a run folder.
const WEIGHTS: &str = "weights.safetensors";
const CONFIG: &str = "config.toml";

/// Where weights are and the configuration of the run that made them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WeightsFile {
    weights: PathBuf,
    config: PathBuf,
    name: String,
}

/// Weights that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{path}: {problem}")]
pub struct WeightsError {
    path: String,
    problem: String,
}

impl WeightsError {
    fn new(path: &Path, problem: impl ToString) -> Self {
        Self { path: path.display().to_string(), problem: problem.to_string() }
    }
}

/// What a file looks like from outside; when it differs the file is read.
type Stamp = Option<(SystemTime, u64)>;

impl WeightsFile {
    /// A run folder, or a weights file with the configuration given or beside it.
    ///
    /// # Errors
    /// Nothing is there, or it is not complete.
    pub fn find(path: &Path, config: Option<&Path>) -> Result<Self, WeightsError> {
        let name = path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
        let (weights, beside) = if path.is_dir() {
            (path.join(WEIGHTS), path.join(CONFIG))
        } else {
            (path.to_owned(), path.with_file_name(CONFIG))
        };
        let config = config.map_or(beside, Path::to_owned);
        if !weights.is_file() {
            return Err(WeightsError::new(
                &weights,
                "there is no such file; give a finished run's folder or its weights",
            ));
        }
        if !config.is_file() {
            return Err(WeightsError::new(
                &config,
                "there is no such file; give the run's configuration with --config",
            ));
        }
        Ok(Self { weights, config, name })
    }

    /// Reads both files and makes a model of them.
    fn load(&self, version: u32, load_scheduler: LoadScheduler) -> Result<Model, WeightsError> {
        let bytes = std::fs::read(&self.weights).map_err(|error| WeightsError::new(&self.weights, error))?;
        let toml = std::fs::read_to_string(&self.config).map_err(|error| WeightsError::new(&self.config, error))?;
        let scheduler = load_scheduler(&bytes, &toml).map_err(|error| WeightsError::new(&self.weights, error))?;
        let (run_id, sha256) = (RunId(self.name.clone()), sha256_hex(&bytes));
        let key = Arc::new(WeightsKey { run_id, version: WeightsVersion(version), sha256 });
        Ok(Model { key, scheduler: Ok(scheduler) })
    }

    fn stamp(&self) -> Stamp {
        let meta = std::fs::metadata(&self.weights).ok()?;
        Some((meta.modified().ok()?, meta.len()))
    }

    /// Loads them once, into the store.
    pub(crate) async fn first(&self, store: &Store, load_scheduler: LoadScheduler) -> Result<Loaded, WeightsError> {
        let (own, stamp) = (self.clone(), self.stamp());
        let load = tokio::task::spawn_blocking(move || own.load(0, load_scheduler));
        let model = load.await.map_err(|error| WeightsError::new(&self.weights, error))??;
        let sha256 = model.key.sha256.clone();
        tracing::info!(weights = %self.weights.display(), sha256, "a model is ready");
        store.insert(model);
        Ok(Loaded { stamp, sha256 })
    }

    /// Loads them again, as the next version, whenever they are replaced. What cannot be used changes nothing.
    pub(crate) async fn follow(self, mut loaded: Loaded, store: Arc<Store>, load_scheduler: LoadScheduler) {
        let mut version = 0;
        loop {
            tokio::time::sleep(INTERVAL).await;
            let stamp = self.stamp();
            if stamp.is_none() || stamp == loaded.stamp {
                continue;
            }
            loaded.stamp = stamp;
            let own = self.clone();
            let load = tokio::task::spawn_blocking(move || own.load(version + 1, load_scheduler));
            match load.await.map_err(|error| WeightsError::new(&self.weights, error)).and_then(|model| model) {
                Ok(model) if model.key.sha256 == loaded.sha256 => {}
                Ok(model) => {
                    version += 1;
                    loaded.sha256.clone_from(&model.key.sha256);
                    tracing::info!(version, sha256 = loaded.sha256, "the weights were replaced");
                    store.insert(model);
                }
                Err(error) => tracing::warn!(%error, "new weights cannot be used; the old ones go on answering"),
            }
        }
    }
}

/// What was loaded last.
#[derive(Debug)]
pub(crate) struct Loaded {
    stamp: Stamp,
    sha256: String,
}
