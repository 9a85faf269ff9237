//! What the learner and the commander take in and read back: results, weights, checkpoints.

use crate::small;
use bytes::Bytes;
use magex_commander::run_scheduler::load_scheduler;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::ids::RunId;
use magex_core::sha256;
use magex_core::trajectory::ShardResult;
use magex_learner::checkpoint::{self, Progress};
use magex_learner::serve::validate::{Limits, validate};
use magex_learner::train::algorithm::Algorithm;
use magex_learner::train::commander_ppo::CommanderPpo;
use magex_learner::train::learned::Learned;
use std::path::{Path, PathBuf};

/// A run whose files are damaged.
#[derive(Debug)]
pub struct Run {
    config: RunConfig,
    toml: String,
    learned: Learned,
    limits: Limits,
    folder: tempfile::TempDir,
    checkpoint: PathBuf,
}

/// Files of a checkpoint, as the first byte of an input chooses them.
const FILES: [&str; 4] = ["state.json", "weights.safetensors", "optimiser.safetensors", "manifest.json"];

impl Default for Run {
    fn default() -> Self {
        let config = small(ExecutorKind::Local, 3, 1);
        let toml = config.to_toml().expect("a configuration can be written");
        let algorithm = Algorithm::new(&config).expect("a small network");
        let commander = CommanderPpo::new(&config.commander, &config.task, 1);
        let learned = Learned::init(&config, &algorithm, &commander).expect("small networks");
        let limits = Limits::for_task(&config.task, 4);
        let folder = tempfile::tempdir().expect("a folder");
        let progress = Progress {
            run_id: "r".into(),
            config_sha256: "c".into(),
            config: String::new(),
            iteration: 1,
            joint_env_steps: 7,
            on_target: 1,
            wall_s: 0.5,
        };
        let checkpoint = checkpoint::write(folder.path(), &progress, &learned, 1).expect("a checkpoint");
        Self { config, toml, learned, limits, folder, checkpoint }
    }
}

impl Run {
    /// The configuration of the run.
    pub fn config(&self) -> &RunConfig {
        &self.config
    }

    /// A result at the learner's door: what gets in is whole and finite.
    pub fn admit(&self, bytes: &[u8]) {
        match validate(&self.limits, &RunId("r".into()), Bytes::copy_from_slice(bytes)) {
            Ok(delivery) => {
                if let ShardResult::Train(trajectory) = &delivery.result {
                    assert_eq!(trajectory.validate(), Ok(()));
                    assert!(trajectory.rewards.iter().all(|reward| reward.is_finite()));
                }
            }
            Err(error) => assert!(!error.field.is_empty() && !error.problem.is_empty()),
        }
    }

    /// A weights file: a scheduler, or an error.
    pub fn weights(&self, bytes: &[u8]) {
        // What fits is a scheduler whatever its numbers are.
        let _ = load_scheduler(bytes, &self.toml);
    }

    /// A good weights file.
    pub fn good_weights(&self) -> Vec<u8> {
        self.learned.weights().expect("weights can be written")
    }

    /// A checkpoint one of whose files is this: the first byte says which, and whether the manifest agrees with it.
    pub fn checkpoint(&self, bytes: &[u8]) {
        let Some((&first, content)) = bytes.split_first() else { return };
        let (file, agrees) = (FILES[usize::from(first % 4)], first & 4 == 0);
        let folder = self.folder.path().join("damaged");
        std::fs::create_dir_all(&folder).expect("a folder");
        for name in FILES {
            std::fs::copy(self.checkpoint.join(name), folder.join(name)).expect("a copy");
        }
        write(&folder.join(file), content);
        if agrees && file != "manifest.json" {
            let manifest = std::fs::read_to_string(folder.join("manifest.json")).expect("a manifest");
            let before = sha256::hex(&std::fs::read(self.checkpoint.join(file)).expect("a file"));
            write(&folder.join("manifest.json"), manifest.replace(&before, &sha256::hex(content)).as_bytes());
        }
        match checkpoint::read(&folder, &self.learned) {
            Ok((_, learned)) => {
                let sizes =
                    |learned: &Learned| learned.networks.iter().map(|n| n.params.values.len()).collect::<Vec<_>>();
                assert_eq!(sizes(&learned), sizes(&self.learned));
            }
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }

    /// Good inputs of [`Run::checkpoint`].
    pub fn good_files(&self) -> Vec<Vec<u8>> {
        let file = |(k, name): (usize, &&str)| {
            let bytes = std::fs::read(self.checkpoint.join(name)).expect("a file");
            [vec![k as u8], bytes].concat()
        };
        FILES.iter().enumerate().map(file).collect()
    }
}

fn write(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).expect("a file can be written");
}
