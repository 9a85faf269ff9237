//! The same configuration and seed give the same bits, however the work is spread; within one process. The same across
//! processes is in `cluster.rs`.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex::local::LocalCollector;
use magex_core::config::{CommanderPolicy, ExecutorKind, RunConfig};
use magex_core::ids::{RunId, Shard};
use magex_core::metrics_table::{COST_RATIO, SUCCESS_RATE};
use magex_core::task::TaskName;
use magex_core::trajectory::ShardResult;
use magex_learner::checkpoint;
use magex_learner::collector::Collector;
use magex_learner::report::observer::{RunObserver, RunStart};
use magex_learner::report::records::{IterationMetrics, Summary};
use magex_learner::run_events::{CollectError, RunEvent, StopReason};
use magex_learner::trainer::{EVAL_SET_TRAINING, TrainOutcome, Trainer};
use magex_proto::v1::IterationEvent;
use magex_proto::weights::Weights;
use magex_tests::{drive, small, small_task, train, updates};
use magex_viewer::page::{Phase, RunEnd};
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

const KINDS: [ExecutorKind; 9] = [
    ExecutorKind::Magex,
    ExecutorKind::MagexLiteral,
    ExecutorKind::Attention,
    ExecutorKind::Mlp,
    ExecutorKind::Local,
    ExecutorKind::Flat,
    ExecutorKind::Mat,
    ExecutorKind::MatDec,
    ExecutorKind::Dicg,
];

fn hash(config: &RunConfig, actors: usize, threads: usize) -> String {
    train(config, tempfile::tempdir().unwrap().path(), actors, threads).sha256
}

#[test]
fn neither_actors_nor_training_threads_reach_a_number() {
    for kind in KINDS {
        let config = small(kind, 5, 3);
        let one = hash(&config, 1, 1);
        assert_eq!(one, hash(&config, 3, 1), "{kind}: three rollout threads");
        assert_eq!(one, hash(&config, 2, 2), "{kind}: two training threads");
    }
}

const TASKS: [TaskName; 2] = [TaskName::PushBall, TaskName::Drones];

#[test]
fn every_task_gives_the_same_bits_and_ratios_of_one() {
    let kinds = [ExecutorKind::Magex, ExecutorKind::Local, ExecutorKind::Flat, ExecutorKind::Mat, ExecutorKind::Dicg];
    for (name, kind) in TASKS.into_iter().flat_map(|name| kinds.map(|kind| (name, kind))) {
        let config = small_task(name, kind, 4, 3);
        let ran = train(&config, tempfile::tempdir().unwrap().path(), 1, 1);
        assert_eq!(ran.sha256, hash(&config, 3, 2), "{name} {kind}: three rollout and two training threads");
        for line in updates(&ran.events).iter().filter(|l| !l["executor"].is_null()) {
            let error = |part: &str| line[part]["first_ratio_error"].as_f64().unwrap();
            assert_eq!(error("executor"), 0.0, "{name} {kind}: iteration {}", line["iteration"]);
            assert!(error("commander") <= 1e-6, "{name} {kind}: iteration {}", line["iteration"]);
            assert_eq!(line["second_cost_ratio"].is_null(), line["success_rate"].is_null() || name == TaskName::Drones);
        }
    }
}

#[test]
fn random_goals_reach_the_share_of_the_training_episodes_and_no_evaluation() {
    let config = small_task(TaskName::Drones, ExecutorKind::Local, 4, 2);
    let mut assigned = config.clone();
    assigned.commander.random_assignment_fraction = 0.0;
    assert_ne!(hash(&config, 1, 1), hash(&assigned, 1, 1));
    let ran = train(&config, tempfile::tempdir().unwrap().path(), 1, 1);
    let TrainOutcome::Finished(summary) = &ran.outcome else { panic!("not finished") };
    let ratio = summary.episodes.greedy[COST_RATIO].unwrap();
    assert!(ratio < 1.2, "evaluations are not given random goals: {ratio}");
    let trained: Vec<f64> = updates(&ran.events).iter().filter_map(|l| l["sampled_cost_ratio"].as_f64()).collect();
    assert!(trained.iter().any(|&ratio| ratio > 1.1), "half of the training episodes are: {trained:?}");
}

#[test]
fn another_seed_learns_something_else() {
    let config = small(ExecutorKind::Local, 5, 2);
    let mut other = config.clone();
    other.run.seed += 1;
    assert_ne!(hash(&config, 1, 1), hash(&other, 1, 1));
}

#[test]
fn a_stopped_and_resumed_run_ends_with_the_same_bits() {
    for kind in [ExecutorKind::Magex, ExecutorKind::Local, ExecutorKind::Flat, ExecutorKind::Mat, ExecutorKind::Dicg] {
        let config = small(kind, 5, 5);
        let whole = hash(&config, 2, 1);
        let folder = tempfile::tempdir().unwrap();
        // A stop is obeyed at the end of an iteration: with the flag set from the start, each attempt does one.
        let stop = Arc::new(AtomicBool::new(true));
        let first = Trainer::create(&config, magex_core::ids::RunId("r".into()), folder.path(), 1).unwrap();
        assert!(matches!(drive(first, &config, 1, &stop).outcome, TrainOutcome::Stopped(_)));
        for _ in 0..2 {
            let (next, skipped) = Trainer::resume(&config, folder.path(), 2).unwrap();
            assert!(skipped.is_empty());
            assert!(matches!(drive(next, &config, 2, &stop).outcome, TrainOutcome::Stopped(_)));
        }
        let (last, _) = Trainer::resume(&config, folder.path(), 1).unwrap();
        let ended = drive(last, &config, 3, &Arc::new(AtomicBool::new(false)));
        assert!(matches!(ended.outcome, TrainOutcome::Finished(_)));
        assert_eq!(ended.sha256, whole, "{kind}");
        let lines = std::fs::read_to_string(folder.path().join("metrics.jsonl")).unwrap();
        let iterations: Vec<u64> = lines
            .lines()
            .map(|l| serde_json::from_str::<serde_json::Value>(l).unwrap()["iteration"].as_u64().unwrap())
            .collect();
        assert_eq!(iterations, [0, 1, 2, 3, 4, 5], "one line per version of the weights");
    }
}

#[test]
fn after_a_corrupt_checkpoint_the_previous_one_leads_to_the_same_bits() {
    let config = small(ExecutorKind::Local, 5, 5);
    let folder = tempfile::tempdir().unwrap();
    let whole = train(&config, folder.path(), 1, 1).sha256;
    let checkpoints = checkpoint::list(folder.path());
    let newest = checkpoints.last().unwrap().join("weights.safetensors");
    let mut bytes = std::fs::read(&newest).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 0x40;
    std::fs::write(&newest, bytes).unwrap();
    let (again, skipped) = Trainer::resume(&config, folder.path(), 1).unwrap();
    assert_eq!(skipped.len(), 1);
    assert!(skipped[0].to_string().contains("checksum"), "{}", skipped[0]);
    assert_eq!(drive(again, &config, 1, &Arc::new(AtomicBool::new(false))).sha256, whole);
}

#[test]
fn a_resume_with_another_configuration_is_refused() {
    let config = small(ExecutorKind::Local, 5, 2);
    let folder = tempfile::tempdir().unwrap();
    train(&config, folder.path(), 1, 1);
    let mut other = config.clone();
    other.mappo.gamma = 0.9;
    let error = Trainer::resume(&other, folder.path(), 1).unwrap_err().to_string();
    assert!(error.contains("mappo.gamma was 0.99 and is 0.9"), "{error}");
}

#[test]
fn the_first_importance_ratio_is_one() {
    for kind in KINDS {
        let ran = train(&small(kind, 6, 3), tempfile::tempdir().unwrap().path(), 2, 1);
        for line in updates(&ran.events).iter().filter(|l| !l["executor"].is_null()) {
            let error = line["executor"]["first_ratio_error"].as_f64().unwrap();
            // The attention ablation uses the tensor library's products, which give a row other bits in a batch.
            let limit = if kind == ExecutorKind::Attention { 1e-6 } else { 0.0 };
            assert!(error <= limit, "{kind}: iteration {} has ratio error {error}", line["iteration"]);
            let error = line["commander"]["first_ratio_error"].as_f64().unwrap();
            assert!(error <= 1e-6, "{kind}: the commander's log-probabilities differ by {error}");
        }
    }
}

#[test]
fn the_first_ratio_of_a_joint_action_is_one_and_it_learns_something_else() {
    let config = small(ExecutorKind::Dicg, 5, 3);
    let mut joint = config.clone();
    joint.mappo.joint_ratio = true;
    let ran = train(&joint, tempfile::tempdir().unwrap().path(), 2, 1);
    for line in updates(&ran.events).iter().filter(|l| !l["executor"].is_null()) {
        assert_eq!(line["executor"]["first_ratio_error"].as_f64(), Some(0.0));
    }
    assert_eq!(ran.sha256, hash(&joint, 1, 2));
    assert_ne!(ran.sha256, hash(&config, 1, 1));
}

#[test]
fn a_frozen_graph_keeps_its_initial_convolutions() {
    let mut config = small(ExecutorKind::Dicg, 5, 2);
    for frozen in [false, true] {
        config.executor.frozen_graph = frozen;
        let folder = tempfile::tempdir().unwrap();
        let before = Trainer::create(&config, RunId("r".into()), folder.path(), 1).unwrap().learned().clone();
        let folder = tempfile::tempdir().unwrap();
        train(&config, folder.path(), 1, 1);
        let after = checkpoint::read_latest(folder.path(), &before).unwrap().1;
        let [before, after] = [&before, &after].map(|learned| learned.network("actor").unwrap().params.clone());
        for entry in &before.entries {
            let same = before.values[entry.range()] == after.values[entry.range()];
            assert_eq!(same, frozen && entry.name.starts_with("graph."), "{} frozen: {frozen}", entry.name);
        }
    }
}

#[test]
fn every_scheduler_trains_and_the_learned_ones_change() {
    for kind in [
        CommanderPolicy::Pairwise,
        CommanderPolicy::Ranking,
        CommanderPolicy::Exact,
        CommanderPolicy::Greedy,
        CommanderPolicy::Random,
    ] {
        let mut config = small(ExecutorKind::Local, 5, 2);
        config.commander.kind = kind;
        let folder = tempfile::tempdir().unwrap();
        let trainer = Trainer::create(&config, RunId("r".into()), folder.path(), 1).unwrap();
        let before = trainer.learned().clone();
        let ran = drive(trainer, &config, 1, &Arc::new(AtomicBool::new(false)));
        let after = checkpoint::read_latest(folder.path(), &before).unwrap().1;
        let TrainOutcome::Finished(summary) = &ran.outcome else { panic!("{kind}: not finished") };
        let ratio = summary.episodes.greedy[COST_RATIO].unwrap();
        assert!(ratio >= 0.999, "{kind}: better than exact");
        if kind == CommanderPolicy::Exact {
            assert!((ratio - 1.0).abs() < 1e-6);
        }
        let changed = before.network("commander").unwrap().params != after.network("commander").unwrap().params;
        assert_eq!(changed, kind.learned(), "{kind}");
    }
}

#[test]
fn it_learns() {
    // Not how fast, only that it does: the default network at N = 5 must beat the untrained one by far.
    let text = "[run]\nseed = 1\nmax_steps = 12000\ntarget_success = 0.97\neval_episodes = 32\nfinal_episodes = 50\n\
                [task]\nname = 'simple-spread'\nagents = 5\nspawn = 'uniform'\n[executor]\nkind = 'local'\n";
    let config = RunConfig::from_toml(text).unwrap();
    let ran = train(&config, tempfile::tempdir().unwrap().path(), 2, 2);
    let TrainOutcome::Finished(summary) = ran.outcome else { panic!("not finished") };
    assert!(summary.episodes.greedy[SUCCESS_RATE].unwrap() > 0.9, "{summary:?}");
}

/// Where a run is interrupted.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Interruption {
    Never,
    /// The plan of this number is not collected.
    Plan(u32),
    /// Told to stop while the plan of this number is collected.
    Drain(u32),
}

/// A collector that is interrupted, and whose evaluations reach the target at these iterations only.
struct Interrupted {
    inner: LocalCollector,
    reached: &'static [u32],
    at: Interruption,
    plans: u32,
}

impl Collector for Interrupted {
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError> {
        self.inner.publish(weights)
    }

    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError> {
        self.plans += 1;
        if self.at == Interruption::Plan(self.plans) {
            return Err(CollectError::Stopped(StopReason::Shutdown));
        }
        let mut results = self.inner.collect(plan)?;
        for result in &mut results {
            if let ShardResult::Eval(outcome) = result
                && outcome.shard.eval_set == EVAL_SET_TRAINING
            {
                let success = if self.reached.contains(&outcome.shard.iteration.0) { 1.0 } else { 0.0 };
                outcome.metrics.iter_mut().for_each(|episode| episode[SUCCESS_RATE] = success);
            }
        }
        Ok(results)
    }

    fn stop_requested(&self) -> Option<StopReason> {
        matches!(self.at, Interruption::Drain(plan) if plan <= self.plans).then(|| StopReason::Drain(String::new()))
    }
}

/// What a run comes to, how it ended and after how many plans.
fn interrupted(
    mut trainer: Trainer,
    config: &RunConfig,
    reached: &'static [u32],
    at: Interruption,
) -> (Option<Summary>, u32) {
    let never = Arc::new(AtomicBool::new(false));
    let inner = LocalCollector::new(config, 1, never);
    let mut collector = Interrupted { inner, reached, at, plans: 0 };
    match trainer.run(&mut collector).unwrap() {
        // The only number that a clock may reach.
        TrainOutcome::Finished(summary) => (Some(Summary { wall_s: 0.0, ..*summary }), collector.plans),
        TrainOutcome::Stopped(_) => (None, collector.plans),
    }
}

#[test]
fn a_run_that_is_interrupted_anywhere_comes_to_what_an_undisturbed_one_comes_to() {
    let mut config = small(ExecutorKind::Local, 5, 4);
    config.run.target_success = 0.9;
    // Evaluations are at 0, 2 and 4, where the budget is spent.
    let cases: [(&[u32], bool, u32); 4] =
        [(&[4], false, 4), (&[2, 4], true, 4), (&[0, 2], true, 2), (&[0, 4], false, 4)];
    for (reached, target_reached, iterations) in cases {
        let folder = tempfile::tempdir().unwrap();
        let trainer = Trainer::create(&config, RunId("r".into()), folder.path(), 1).unwrap();
        let (undisturbed, plans) = interrupted(trainer, &config, reached, Interruption::Never);
        let expected = undisturbed.unwrap();
        assert_eq!((expected.target_reached, expected.iterations), (target_reached, iterations), "{reached:?}");
        for at in (1..=plans).flat_map(|plan| [Interruption::Plan(plan), Interruption::Drain(plan)]) {
            let folder = tempfile::tempdir().unwrap();
            let trainer = Trainer::create(&config, RunId("r".into()), folder.path(), 1).unwrap();
            let summary = match interrupted(trainer, &config, reached, at).0 {
                Some(summary) => summary,
                None => {
                    let (trainer, skipped) = Trainer::resume(&config, folder.path(), 1).unwrap();
                    assert!(skipped.is_empty());
                    interrupted(trainer, &config, reached, Interruption::Never).0.unwrap()
                }
            };
            assert_eq!(summary, expected, "{reached:?} interrupted at {at:?}");
        }
    }
}

/// Records the calls it receives, and whether the line of an iteration is on disk when it is reported.
#[derive(Debug, Default)]
struct Witness {
    folder: PathBuf,
    calls: Arc<Mutex<Vec<String>>>,
}

impl Witness {
    fn call(&self, call: impl Into<String>) {
        self.calls.lock().unwrap().push(call.into());
    }
}

impl RunObserver for Witness {
    fn begin(&mut self, start: RunStart<'_>) {
        self.folder = start.folder.to_owned();
        self.call("begin");
    }

    fn phase(&mut self, phase: Phase) {
        self.call(format!("{phase:?}"));
    }

    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationEvent) {
        let lines = std::fs::read_to_string(self.folder.join("metrics.jsonl")).unwrap();
        let written = lines.lines().next_back() == Some(&report.metrics_json);
        self.call(format!("iteration {} {}", report.iteration, if written { "on disk" } else { "not on disk" }));
    }

    fn event(&mut self, event: &RunEvent) {
        match event {
            RunEvent::Iteration(_) => {}
            RunEvent::Checkpoint(checkpoint) => self.call(format!("checkpoint {}", checkpoint.iteration)),
            RunEvent::Finished(_) => self.call("finished"),
            other => self.call(format!("{other:?}")),
        }
    }

    fn end(&mut self, end: &RunEnd) {
        self.call(if matches!(end, RunEnd::Finished(_)) { "end: finished" } else { "end" });
    }
}

#[test]
fn observers_follow_a_run_in_order_and_change_no_number() {
    let config = small(ExecutorKind::Local, 5, 2);
    let alone = train(&config, tempfile::tempdir().unwrap().path(), 1, 1);
    let folder = tempfile::tempdir().unwrap();
    let mut trainer = Trainer::create(&config, RunId("test".into()), folder.path(), 1).unwrap();
    let witness = Witness::default();
    let calls = witness.calls.clone();
    trainer.observe(witness);
    let observed = drive(trainer, &config, 1, &Arc::new(AtomicBool::new(false)));
    assert_eq!(observed.sha256, alone.sha256);
    let expected = [
        "begin",
        "Collecting",
        "Training",
        "iteration 0 on disk",
        "Collecting",
        "Training",
        "iteration 1 on disk",
        "checkpoint 2",
        "Evaluating",
        "iteration 2 on disk",
        "checkpoint 2",
        "Evaluating",
        "finished",
        "end: finished",
    ];
    assert_eq!(*calls.lock().unwrap(), expected);
}
