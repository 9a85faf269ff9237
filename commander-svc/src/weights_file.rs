//! Weights from a run folder or a file, reloaded whenever the file is replaced.

use crate::model_store::{Model, ModelStore};
use crate::scheduler::{LoadScheduler, WeightsKey};
use magex_core::ids::{RunId, WeightsVersion};
use magex_proto::weights::sha256_hex;
use magex_runtime::exit::Failure;
use magex_runtime::options;
use std::fmt::Display;
use std::io::{ErrorKind, Read as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

/// Polling interval of the files.
const INTERVAL: Duration = Duration::from_secs(1);

/// File names in a run folder.
const WEIGHTS: &str = "weights.safetensors";
const CONFIG: &str = "config.toml";

/// The weights of a run and its configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WeightsFile {
    weights: PathBuf,
    config: PathBuf,
    /// The option that names it, unless it is beside the weights.
    option: &'static str,
    name: String,
}

/// A file that is unusable.
fn unusable(path: &Path, problem: impl Display) -> Failure {
    Failure::usage(format!("{}: {problem}", path.display()))
}

/// A file of this format begins with the length of its header, which is JSON.
fn looks_like_weights(path: &Path) -> bool {
    let mut start = [0; 9];
    let read = std::fs::File::open(path).and_then(|mut file| file.read_exact(&mut start));
    // A file that cannot be read gets the error of its reading.
    read.map_or_else(|error| error.kind() != ErrorKind::UnexpectedEof, |()| start[8] == b'{')
}

/// Modification time and size of both files; when it differs they are read.
type Stamp = [(SystemTime, u64); 2];

/// SHA-256 of the weights and of the configuration.
type Content = [String; 2];

impl WeightsFile {
    /// A run folder, or a weights file with the configuration given or beside it. Both must exist.
    pub fn find(path: &Path, config: Option<&Path>) -> Result<Self, Failure> {
        let name = path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
        let (weights, beside) = if path.is_dir() {
            (path.join(WEIGHTS), path.join(CONFIG))
        } else {
            (path.to_owned(), path.with_file_name(CONFIG))
        };
        let option = if config.is_some() { "--config" } else { "" };
        let config = config.map_or(beside, Path::to_owned);
        if path.is_file() && !looks_like_weights(path) {
            return Err(unusable(
                path,
                "not a weights file (safetensors); give the folder of a finished run, or its weights file",
            ));
        }
        if !weights.is_file() {
            return Err(unusable(&weights, "no such file; give the folder of a finished run, or its weights file"));
        }
        if !config.is_file() && !looks_like_weights(&weights) {
            return Err(unusable(
                &weights,
                "no weights file; give the folder of a finished run, or its weights.safetensors",
            ));
        }
        if !config.is_file() {
            return Err(unusable(&config, "no such file; give the run's configuration with --config"));
        }
        Ok(Self { weights, config, option, name })
    }

    /// Reads both files and loads the model, on a thread that may block. Returns their hashes, too, to detect a change of content.
    async fn load(&self, version: u32, load_scheduler: LoadScheduler) -> Result<(Model, Content), Failure> {
        let own = self.clone();
        let loading = tokio::task::spawn_blocking(move || own.load_here(version, load_scheduler));
        loading.await.map_err(|error| unusable(&self.weights, error))?
    }

    fn load_here(&self, version: u32, load_scheduler: LoadScheduler) -> Result<(Model, Content), Failure> {
        let bytes =
            std::fs::read(&self.weights).map_err(|error| unusable(&self.weights, options::unreadable(&error)))?;
        let toml = options::text_file(self.option, &self.config)?;
        let scheduler = load_scheduler(&bytes, &toml).map_err(|error| unusable(&self.weights, error))?;
        let (run_id, sha256) = (RunId(self.name.clone()), sha256_hex(&bytes));
        let content = [sha256.clone(), sha256_hex(toml.as_bytes())];
        let key = Arc::new(WeightsKey { run_id, version: WeightsVersion(version), sha256 });
        Ok((Model { key, scheduler: Ok(scheduler) }, content))
    }

    /// `None` while a file is missing.
    fn stamp(&self) -> Option<Stamp> {
        let stamp = |path: &Path| {
            let meta = std::fs::metadata(path).ok()?;
            Some((meta.modified().ok()?, meta.len()))
        };
        Some([stamp(&self.weights)?, stamp(&self.config)?])
    }

    /// Loads the model for the first time.
    pub(crate) async fn first(&self, store: &ModelStore, load_scheduler: LoadScheduler) -> Result<Loaded, Failure> {
        let stamp = self.stamp();
        let (model, content) = self.load(0, load_scheduler).await?;
        let sha256 = &model.key.sha256;
        tracing::info!(weights = %self.weights.display(), sha256, "a model is ready");
        store.insert(model);
        Ok(Loaded { stamp, content })
    }

    /// Loads the next version whenever a file is replaced. Unusable files change nothing and are retried, because the other
    /// file, or the rest of this one, may still be written.
    pub(crate) async fn follow(self, mut loaded: Loaded, store: Arc<ModelStore>, load_scheduler: LoadScheduler) {
        let (mut version, mut warned) = (0, None);
        loop {
            tokio::time::sleep(INTERVAL).await;
            let stamp = self.stamp();
            if stamp.is_none() || stamp == loaded.stamp {
                continue;
            }
            match self.load(version + 1, load_scheduler).await {
                Ok((_, content)) if content == loaded.content => loaded.stamp = stamp,
                Ok((model, content)) => {
                    version += 1;
                    tracing::info!(version, sha256 = model.key.sha256, "the weights were replaced");
                    loaded = Loaded { stamp, content };
                    store.insert(model);
                }
                // Warns once per state of the files.
                Err(error) if warned != stamp => {
                    warned = stamp;
                    tracing::warn!(%error, "the new weights are unusable; the previous ones stay in use");
                }
                Err(_) => {}
            }
        }
    }
}

/// The files that were loaded last.
#[derive(Debug)]
pub(crate) struct Loaded {
    /// Their stamp before they were read.
    stamp: Option<Stamp>,
    content: Content,
}
