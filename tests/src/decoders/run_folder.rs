//! The folder of a run that was killed, whatever was done to its files since: a resume refuses it by name, or has the numbers that the
//! run had and whole lines, and names the lines that are missing.

use crate::small;
use magex::local::LocalCollector;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::ids::RunId;
use magex_learner::checkpoint;
use magex_learner::report::observer::RunObserver;
use magex_learner::report::records::IterationMetrics;
use magex_learner::run_folder::{Claim, RunFolderState};
use magex_learner::train::learned::Learned;
use magex_learner::trainer::Trainer;
use magex_proto::v1::IterationEvent;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Iterations that were trained, and that were to be.
const TRAINED: u32 = 6;
const ITERATIONS: u64 = 10;

/// A run that was stopped in the middle, and what it had learned.
#[derive(Debug)]
pub struct RunFolder {
    config: RunConfig,
    /// Its files, with paths below the folder.
    files: Vec<(PathBuf, Vec<u8>)>,
    /// What its checkpoints hold, by iteration.
    states: BTreeMap<u32, Learned>,
}

/// What became of a damaged folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// It was not used, for this reason.
    Refused(String),
    /// The run goes on from this iteration; the number of its lines that are missing, and named.
    Resumed(u32, usize),
    /// Nothing is left of what was trained: the run begins again.
    Anew,
}

#[derive(Debug)]
struct StopAt(Arc<AtomicBool>);

impl RunObserver for StopAt {
    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationEvent) {
        self.0.store(report.iterations_completed >= TRAINED, Ordering::SeqCst);
    }
}

impl Default for RunFolder {
    fn default() -> Self {
        let mut config = small(ExecutorKind::Local, 3, ITERATIONS);
        config.executor.hidden = 8;
        let config = config.validated().expect("a small configuration");
        let place = tempfile::tempdir().expect("a folder");
        let (run, toml) = (place.path().join("run"), config.to_toml().expect("a configuration"));
        drop(Claim::begin(&run, &toml, "test", false).expect("a new run"));
        let mut trainer = Trainer::create(&config, RunId("r".into()), &run, 1).expect("a new run");
        let stop = Arc::new(AtomicBool::new(false));
        trainer.observe(StopAt(stop.clone()));
        trainer.run(&mut LocalCollector::new(&config, 1, stop)).expect("training");
        let template = trainer.learned().clone();
        let read = |folder: PathBuf| {
            let (progress, learned) = checkpoint::read(&folder, &template).expect("a checkpoint");
            (progress.iteration, learned)
        };
        let states = checkpoint::list(&run).into_iter().map(read).collect();
        let mut files = Vec::new();
        collect(&run, Path::new(""), &mut files);
        files.sort();
        Self { config, files, states }
    }
}

fn collect(run: &Path, below: &Path, files: &mut Vec<(PathBuf, Vec<u8>)>) {
    for entry in fs::read_dir(run.join(below)).expect("a folder").filter_map(Result::ok) {
        let path = below.join(entry.file_name());
        match entry.path().is_dir() {
            true => collect(run, &path, files),
            false => files.push((path, fs::read(entry.path()).expect("a file"))),
        }
    }
}

/// The bytes of an input, one choice after the other; zeros at its end.
struct Choices<'a>(&'a [u8]);

impl Choices<'_> {
    fn byte(&mut self) -> usize {
        let Some((&first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        usize::from(first)
    }

    /// A number below `bound`, which is not 0.
    fn below(&mut self, bound: usize) -> usize {
        let wide = self.byte() << 16 | self.byte() << 8 | self.byte();
        wide % bound.max(1)
    }
}

impl RunFolder {
    /// Does to the files what an input says, and resumes.
    pub fn attack(&self, bytes: &[u8]) -> Verdict {
        let place = tempfile::tempdir().expect("a folder");
        let run = place.path().join("run");
        let mut choices = Choices(bytes);
        let mut files: BTreeMap<PathBuf, Vec<u8>> = self.files.iter().cloned().collect();
        let mut folders = Vec::new();
        while !choices.0.is_empty() {
            self.damage(&mut files, &mut folders, &mut choices);
        }
        fs::create_dir(&run).expect("a folder");
        for folder in &folders {
            let _ = fs::create_dir_all(run.join(folder));
        }
        for (path, content) in &files {
            // A folder may be where the file belongs, or a file where its folder belongs.
            let _ = fs::create_dir_all(run.join(path.parent().unwrap_or(Path::new(""))));
            let _ = fs::write(run.join(path), content);
        }
        self.resume(&run)
    }

    /// One mutation that knows what a run folder consists of.
    fn damage(&self, files: &mut BTreeMap<PathBuf, Vec<u8>>, folders: &mut Vec<PathBuf>, choices: &mut Choices<'_>) {
        let (kind, which) = (choices.byte() % 14, choices.byte());
        let Some(path) = files.keys().nth(which % files.len().max(1)).cloned() else { return choices.0 = &[] };
        let (at, length) = (choices.below(files[&path].len()), 1 + choices.byte());
        let checkpoint = |path: &Path| path.components().nth(1).map(|name| PathBuf::from("checkpoints").join(name));
        let content = files.entry(path.clone()).or_default();
        let end = (at + length).min(content.len());
        match kind {
            0 if !content.is_empty() => content[at] ^= 1 << (length % 8),
            1 => content.truncate(at),
            2 => content[at.min(end)..end].fill(0),
            3 => content.extend_from_within(..),
            4 => drop(files.remove(&path)),
            5 => {
                files.remove(&path);
                folders.push(path);
            }
            // The content of another file.
            6 => {
                let other = &self.files[at % self.files.len()].1;
                content.clone_from(other);
            }
            // Bytes of the input.
            7 => {
                let (new, rest) = choices.0.split_at(length.min(choices.0.len()));
                drop(content.splice(at.min(end)..end, new.iter().copied()));
                choices.0 = rest;
            }
            // Lines: removed, repeated, exchanged, half.
            8..=11 => {
                let mut lines: Vec<Vec<u8>> =
                    content.split_inclusive(|&byte| byte == b'\n').map(<[u8]>::to_vec).collect();
                let line = at % lines.len().max(1);
                match (kind, lines.get(line).cloned()) {
                    (_, None) => {}
                    (8, _) => drop(lines.remove(line)),
                    (9, Some(same)) => lines.insert(length % (lines.len() + 1), same),
                    (10, _) => {
                        let other = length % lines.len();
                        lines.swap(line, other);
                    }
                    (_, Some(same)) => lines[line].truncate(length % same.len().max(1)),
                }
                *content = lines.concat();
            }
            // Another name for a checkpoint, one that a kill leaves or none that is known.
            12 => {
                let Some(from) = checkpoint(&path) else { return };
                let to = ["000004", "000009", ".000006.old", ".000006.tmp", "4294967296", "000006 (copy)"][at % 6];
                let to = Path::new("checkpoints").join(to);
                let moved: Vec<PathBuf> = files.keys().filter(|path| path.starts_with(&from)).cloned().collect();
                for path in moved {
                    let below = path.strip_prefix(&from).map(|below| to.join(below));
                    if let (Some(content), Ok(below)) = (files.remove(&path), below) {
                        files.insert(below, content);
                    }
                }
            }
            // All of a checkpoint, or of another folder.
            _ => {
                let folder = checkpoint(&path).or_else(|| Some(path.parent()?.to_owned())).unwrap_or_default();
                if folder != Path::new("") {
                    files.retain(|path, _| !path.starts_with(&folder));
                }
            }
        }
    }

    /// As a learner continues a run.
    fn resume(&self, run: &Path) -> Verdict {
        let refused = |text: String| {
            assert!(text.len() > 20, "the refusal says nothing: {text}");
            let named = ["run/", "run:", "run ", ": ", "configuration"].iter().any(|word| text.contains(word));
            assert!(named, "the refusal names no file and no key: {text}");
            Verdict::Refused(text)
        };
        match RunFolderState::of(run) {
            RunFolderState::Run => {}
            // What a learner says of it is a matter of names only.
            RunFolderState::Other => {
                return Verdict::Refused("not a run folder, or its checkpoints are missing".to_owned());
            }
            RunFolderState::Begun | RunFolderState::Empty => return Verdict::Anew,
        }
        if let Err(error) = checkpoint::check_format(run) {
            return refused(error.to_string());
        }
        let path = run.join("config.toml");
        let text = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) => return refused(format!("{}: {error}", path.display())),
        };
        let config = match RunConfig::from_toml(&text) {
            Ok(config) => config,
            Err(error) => return refused(format!("{}: {error}", path.display())),
        };
        let (trainer, _) = match Trainer::resume(&config, run, 1) {
            Ok(resumed) => resumed,
            Err(error) => return refused(error.to_string()),
        };
        let state = self.states.iter().find(|(_, state)| *state == trainer.learned());
        let (&iteration, _) = state.expect("a resume has the numbers of one of the run's checkpoints");
        // Keys of [run] may be other ones now; what was learned is the same.
        assert_eq!(config.task, self.config.task);
        let missing = trainer.missing_lines();
        if !run.join("summary.json").exists() {
            let text = fs::read_to_string(run.join("metrics.jsonl")).expect("a resumed run has metrics");
            let number = |line: &str| {
                let value: serde_json::Value = serde_json::from_str(line).expect("a whole line");
                value["iteration"].as_u64().expect("the line of an iteration") as u32
            };
            let numbers: Vec<u32> = text.lines().map(number).collect();
            let expected: Vec<u32> = (0..iteration).filter(|number| !missing.contains(number)).collect();
            assert_eq!(numbers, expected, "every line is there once and in order, or named as missing");
        }
        Verdict::Resumed(iteration, missing.len())
    }
}
