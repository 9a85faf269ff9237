//! Deterministic simulation: the product's ledger, roster and sessions with simulated actors, wires and time, in one thread. A seed
//! decides what is delayed, repeated, reordered, cut off, stopped, hung, killed and restarted; a failure names its seed.
//!
//! After every step: every lease is accounted for, no shard counts twice, and a lease that is out for too long is in the log. While
//! actor 0 is healthy, an iteration ends within [`Bounds`], whatever happens to the others.
//!
//! `MAGEX_SCHEDULES=100000 cargo test --release -p magex-learner --lib simulation -- --nocapture` tries more schedules,
//! `MAGEX_FIRST_SEED` begins elsewhere.

mod actor;
mod log;

use self::actor::{Simulated, TICK};
use crate::collector::Collector as _;
use crate::fixtures;
use crate::report::bottleneck::CollectTiming;
use crate::run_events::CollectError;
use crate::run_identity::RunIdentity;
use crate::serve::grpc_collector::GrpcCollector;
use crate::serve::judge::Judge;
use crate::serve::shared::Shared;
use crate::serve::validate::Limits;
use magex_core::ids::{RunId, Shard, ShardKind, WeightsVersion};
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::{Instant, sleep};
use tokio_util::sync::CancellationToken;

/// The default time of a lease.
const LEASE: Duration = Duration::from_secs(15);
const ACTORS: usize = 4;
const ITERATIONS: u32 = 8;
const EVALUATIONS: u32 = 1;
const TRAININGS: u32 = 5;

/// An iteration ends within this time while one actor is healthy and the durations of shards are known: that actor alone takes less
/// than 4 s for all shards, and each may wait for a late lease of less than 1 s first.
const BOUND: Duration = Duration::from_secs(10);
/// The same after a start of the learner: it waits for a whole lease before it takes one for late.
const FIRST_BOUND: Duration = Duration::from_secs(15 + 10);

/// What is taken out of the product to see whether the simulation finds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Product {
    Whole,
    WithoutHedges,
}

/// What may happen to actors 1 and up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Troubles {
    All,
    /// One actor cannot reach the commander; nothing else happens.
    NoCommander,
    /// A rollout thread of one actor hangs; nothing else happens.
    Hang,
}

/// The service of a learner's process, and when it goes away.
#[derive(Clone)]
struct Process {
    shared: Arc<Shared>,
    gone: CancellationToken,
}

pub(super) struct World {
    seed: u64,
    product: Product,
    learner: RefCell<Process>,
    /// Since when the commander is away for everyone.
    commander_away: Cell<bool>,
    actors: Vec<Simulated>,
    /// `trained` of the ledger when the open plan was opened.
    trained_before: Cell<u64>,
    /// Actors that compute wrong results, and those that were convicted.
    liars: RefCell<Vec<u64>>,
    convicted: Cell<u32>,
    /// Leases that were out for too long and therefore must be in the log.
    stalls: Cell<u64>,
    encoded: RefCell<BTreeMap<(u32, u32, bool, bool), bytes::Bytes>>,
}

fn run_id() -> RunId {
    RunId("run".into())
}

fn weights(version: u32) -> Arc<Weights> {
    Arc::new(Weights::new(run_id(), WeightsVersion(version), bytes::Bytes::from(version.to_le_bytes().to_vec())))
}

fn plan(iteration: u32) -> Vec<Shard> {
    let evaluation = |index| Shard { kind: ShardKind::Eval, eval_set: 1, ..fixtures::train_shard(iteration, index, 2) };
    let training = |index| fixtures::train_shard(iteration, index, 2);
    (0..EVALUATIONS).map(evaluation).chain((0..TRAININGS).map(training)).collect()
}

/// The result of a shard; a liar's differs in the last place of one number.
fn result(shard: &Shard, lie: bool) -> ShardResult {
    let task = fixtures::task();
    let ulp = |x: &mut f32| *x = f32::from_bits(x.to_bits() + 1);
    match shard.kind {
        ShardKind::Train => {
            let mut trajectory = fixtures::trajectory(&task, *shard);
            if lie {
                ulp(&mut trajectory.rewards[0]);
            }
            ShardResult::Train(trajectory)
        }
        ShardKind::Eval => {
            let mut outcome = fixtures::eval_outcome(&task, *shard, false);
            if lie {
                ulp(&mut outcome.metrics[0].0[0]);
            }
            ShardResult::Eval(outcome)
        }
    }
}

impl World {
    fn stream(&self, what: &[u32]) -> Stream {
        Key::new(self.seed, Purpose::Bench, what).stream()
    }

    fn learner(&self) -> Process {
        self.learner.borrow().clone()
    }

    fn start_learner(seed: u64, number: u64, product: Product) -> Process {
        let run = RunIdentity {
            run_id: run_id(),
            name: "simulation".into(),
            task_fingerprint: fixtures::task().fingerprint(),
            run_config_toml: String::new(),
            seed: 7,
            lease: LEASE,
        };
        let limits = Limits { recompute: 0.1, ..Limits::for_task(&fixtures::task(), 2) };
        let shared = Shared::numbered(run, limits, (seed + number) << 32, seed + number);
        shared.work.with_ledger(|ledger| ledger.hedges = product == Product::Whole);
        Process { shared: Arc::new(shared), gone: CancellationToken::new() }
    }

    fn new(seed: u64, product: Product) -> Rc<Self> {
        let learner = RefCell::new(Self::start_learner(seed, 0, product));
        Rc::new(Self {
            seed,
            product,
            learner,
            commander_away: Cell::new(false),
            actors: (0..ACTORS).map(|_| Simulated::default()).collect(),
            trained_before: Cell::new(0),
            liars: RefCell::default(),
            convicted: Cell::new(0),
            stalls: Cell::new(0),
            encoded: RefCell::default(),
        })
    }

    /// What holds after every step.
    fn check(&self) {
        let seed = self.seed;
        let Process { shared, .. } = self.learner();
        let sessions = shared.roster.sessions();
        shared.work.inspect(|ledger| {
            let (shards, episodes) = (ledger.counters(), ledger.episodes());
            assert_eq!((shards.residual, episodes.residual), (0, 0), "seed {seed}: a lease is lost");
            let (done, total) = ledger.progress();
            assert!(done <= total, "seed {seed}: {done} of {total}");
            assert_eq!(
                shards.trained,
                self.trained_before.get() + done as u64,
                "seed {seed}: a shard counts twice, or not at all"
            );
            for (session, entry) in &sessions {
                // The session looks whenever it hears its actor; one that falls silent is in the log for that.
                let stalled = |oldest: &super::ledger::OldestLease| {
                    entry.last_seen > oldest.since + ledger.stalled(oldest.shard.kind)
                };
                if ledger.oldest_of(*session).as_ref().is_some_and(stalled) {
                    self.stalls.set(self.stalls.get() + 1);
                    assert!(log::stalls() > 0, "seed {seed}: a stall without a word");
                }
            }
        });
    }

    /// The training loop, without training.
    async fn train(self: Rc<Self>) {
        let mut random = self.stream(&[1]);
        let (mut iteration, mut checkpoint) = (0, 0);
        while iteration < ITERATIONS {
            let process = self.learner();
            let mut collector = self.collector(&process);
            let mut first = true;
            while iteration < ITERATIONS && !process.gone.is_cancelled() {
                collector.publish(&weights(iteration)).unwrap();
                let trained = process.shared.work.inspect(|ledger| ledger.counters().trained);
                self.trained_before.set(trained);
                collector.open(plan(iteration)).unwrap();
                match self.collect(&process, &mut collector, if first { FIRST_BOUND } else { BOUND }).await {
                    None => break,
                    Some(Ok(results)) => {
                        let shards: Vec<Shard> = results.iter().map(|result| *result.shard()).collect();
                        assert_eq!(shards, plan(iteration), "seed {}", self.seed);
                        first = false;
                    }
                    Some(Err(CollectError::Convicted(conviction))) => {
                        let liar = self.liars.borrow().contains(&conviction.origin.process);
                        assert!(liar, "seed {}: an honest actor is convicted: {conviction:?}", self.seed);
                        self.convicted.set(self.convicted.get() + 1);
                        if let Some(since) = conviction.since.filter(|since| *since < iteration) {
                            iteration = since;
                            checkpoint = checkpoint.min(since);
                            collector.went_back(since);
                        }
                        first = true;
                        continue;
                    }
                    Some(Err(error)) => panic!("seed {}: {error}", self.seed),
                }
                // The update.
                sleep(up_to(&mut random, 300)).await;
                iteration += 1;
                if iteration.is_multiple_of(2) {
                    checkpoint = iteration;
                }
            }
            if process.gone.is_cancelled() {
                iteration = checkpoint;
                sleep(Duration::from_millis(200) + up_to(&mut random, 800)).await;
            }
        }
    }

    fn collector(&self, process: &Process) -> GrpcCollector {
        GrpcCollector {
            shared: process.shared.clone(),
            timing: CollectTiming::default(),
            judge: Judge::new(Box::new(|shard, _| Ok(result(shard, false)))),
            shards: Vec::new(),
            origins: Vec::new(),
            unconfirmed: BTreeMap::new(),
        }
    }

    /// The results of the open plan, which arrive in time; `None` if the learner is killed.
    async fn collect(
        &self,
        process: &Process,
        collector: &mut GrpcCollector,
        bound: Duration,
    ) -> Option<Result<Vec<ShardResult>, CollectError>> {
        let mut working = Duration::ZERO;
        loop {
            sleep(TICK).await;
            if process.gone.is_cancelled() {
                return None;
            }
            self.check();
            if let Some(end) = collector.poll() {
                if let Err(CollectError::Convicted(_)) | Ok(_) = &end {
                    let trained = process.shared.work.inspect(|ledger| ledger.counters().trained);
                    self.trained_before.set(trained);
                }
                return Some(end);
            }
            // Nothing can be done without a commander.
            working = if self.commander_away.get() { Duration::ZERO } else { working + TICK };
            let ledger = process.shared.work.inspect(|ledger| ledger.counters());
            assert!(working < bound, "seed {}: no iteration for {working:?}: {ledger:?}", self.seed);
        }
    }

    /// What happens to the processes.
    async fn trouble(self: Rc<Self>, troubles: Troubles) {
        let mut random = self.stream(&[2]);
        match troubles {
            Troubles::NoCommander => self.actors[1].no_commander.set(true),
            Troubles::Hang => {
                sleep(Duration::from_millis(1500)).await;
                self.actors[1].hung.set(true);
            }
            Troubles::All => loop {
                sleep(up_to(&mut random, 3000)).await;
                let victim = &self.actors[1 + random.below(ACTORS as u32 - 1) as usize];
                match random.below(12) {
                    0 => victim.hung.set(true),
                    1 => victim.frozen.set(Instant::now() + up_to(&mut random, 40_000)),
                    2 | 3 => victim.killed.set(true),
                    4 => victim.no_commander.set(true),
                    5 => victim.no_commander.set(false),
                    6 => victim.cut.set(true),
                    7 => victim.silent_wire.set(Instant::now() + up_to(&mut random, 40_000)),
                    8 => victim.refuses.set(!victim.refuses.get()),
                    9 => victim.lies.set(random.below(3) == 0),
                    10 => {
                        self.commander_away.set(true);
                        sleep(up_to(&mut random, 4000)).await;
                        self.commander_away.set(false);
                    }
                    _ => {
                        let number = self.seed.wrapping_add(random.bits64() | 1);
                        let old = self.learner.replace(Self::start_learner(self.seed, number >> 8, self.product));
                        self.trained_before.set(0);
                        old.gone.cancel();
                    }
                }
            },
        }
    }
}

/// Plays one schedule; how many actors were convicted, and how many stalls there were.
fn play(seed: u64, product: Product, troubles: Troubles) -> (u32, u64) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build().unwrap();
    log::capture(|| {
        let local = tokio::task::LocalSet::new();
        local.block_on(&runtime, async {
            let world = World::new(seed, product);
            for actor in 0..ACTORS {
                tokio::task::spawn_local(actor::run(world.clone(), actor));
            }
            tokio::task::spawn_local(world.clone().trouble(troubles));
            world.clone().train().await;
            world.check();
            (world.convicted.get(), world.stalls.get())
        })
    })
}

/// A time below this number of milliseconds.
fn up_to(random: &mut Stream, milliseconds: u32) -> Duration {
    Duration::from_millis(random.below(milliseconds).into())
}

fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).ok().and_then(|text| text.parse().ok()).unwrap_or(otherwise)
}

#[test]
fn no_schedule_loses_a_lease_or_stops_the_run() {
    let (first, count) = (number("MAGEX_FIRST_SEED", 1), number("MAGEX_SCHEDULES", 2000));
    let (mut convicted, mut stalls) = (0, 0);
    for seed in first..first + count {
        let (guilty, late) = play(seed, Product::Whole, Troubles::All);
        convicted += u64::from(guilty);
        stalls += u64::from(late > 0);
    }
    println!("{count} schedules from seed {first}: {convicted} actors convicted, stalls in {stalls} of them");
    // Otherwise the schedules would be too kind.
    assert!(count < 100 || (convicted > 0 && stalls > 0));
}

#[test]
fn the_same_seed_gives_the_same_schedule() {
    for seed in [3, 4] {
        assert_eq!(play(seed, Product::Whole, Troubles::All), play(seed, Product::Whole, Troubles::All));
    }
}

/// How many of ten schedules show that something is missing.
fn found(product: Product, troubles: Troubles) -> usize {
    (1..=10).filter(|&seed| std::panic::catch_unwind(|| play(seed, product, troubles)).is_err()).count()
}

#[test]
fn an_actor_that_hangs_is_found_without_hedges_and_costs_nothing_with_them() {
    assert_eq!(found(Product::Whole, Troubles::Hang), 0);
    assert!(found(Product::WithoutHedges, Troubles::Hang) > 0);
}

#[test]
fn an_actor_without_a_commander_is_found_without_hedges_and_costs_nothing_with_them() {
    assert_eq!(found(Product::Whole, Troubles::NoCommander), 0);
    assert!(found(Product::WithoutHedges, Troubles::NoCommander) > 0);
}
