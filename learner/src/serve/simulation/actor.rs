//! A simulated actor: what `session` of `magex-actor` does, in steps of simulated time, over a wire that misbehaves.

use super::{LEASE, Process, World, result, run_id, up_to, weights};
use crate::serve::session::serve_stream;
use magex_core::ids::{Shard, ShardKind};
use magex_core::rng::Stream;
use magex_proto::convert::{encode_result, shard as read_shard};
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, parts, v1};
use std::cell::Cell;
use std::collections::BTreeMap;
use std::rc::Rc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

/// The step of simulated time.
pub(super) const TICK: Duration = Duration::from_millis(25);

/// What is wrong with an actor.
pub(super) struct Simulated {
    /// Its rollout threads do not move; its connection lives.
    pub(super) hung: Cell<bool>,
    /// All of it stands still until then.
    pub(super) frozen: Cell<Instant>,
    /// It dies, and another process takes its place.
    pub(super) killed: Cell<bool>,
    /// It cannot reach the commander.
    pub(super) no_commander: Cell<bool>,
    /// Its connection breaks.
    pub(super) cut: Cell<bool>,
    /// Its wire carries nothing until then, and neither end hears of it.
    pub(super) silent_wire: Cell<Instant>,
    /// It gives every lease back at once.
    pub(super) refuses: Cell<bool>,
    /// It computes wrong results.
    pub(super) lies: Cell<bool>,
}

impl Default for Simulated {
    fn default() -> Self {
        let (no, now) = (|| Cell::new(false), || Cell::new(Instant::now()));
        Self {
            hung: no(),
            frozen: now(),
            killed: no(),
            no_commander: no(),
            cut: no(),
            silent_wire: now(),
            refuses: no(),
            lies: no(),
        }
    }
}

/// A leased shard.
struct Job {
    lease: u64,
    shard: Shard,
    /// Since when it waits for the commander.
    asked: Instant,
    /// When it is done, once it has goals.
    done: Option<Instant>,
}

struct Connection {
    up: mpsc::Sender<v1::RolloutRequest>,
    down: mpsc::Receiver<Result<v1::RolloutResponse, Status>>,
}

/// Lives for ever, in one process after another.
pub(super) async fn run(world: Rc<World>, number: usize) {
    let mut random = world.stream(&[3, number as u32]);
    loop {
        let process = random.bits64();
        let evicted = live(&world, number, process, &mut random).await;
        let own = &world.actors[number];
        own.killed.set(false);
        // A new process has a thread that moves, and memory that holds.
        own.hung.set(false);
        if evicted {
            own.lies.set(false);
        }
        sleep(Duration::from_millis(100) + up_to(&mut random, 900)).await;
    }
}

/// One process, until it dies; whether it was evicted.
async fn live(world: &Rc<World>, number: usize, process: u64, random: &mut Stream) -> bool {
    let own = &world.actors[number];
    let threads = 1 + random.below(2) as usize;
    let mut jobs: Vec<Job> = Vec::new();
    let mut unacknowledged: BTreeMap<u64, Shard> = BTreeMap::new();
    loop {
        let Some(mut connection) = connect(world, number, process, random).await else {
            if own.killed.get() {
                return false;
            }
            continue;
        };
        own.cut.set(false);
        for (lease, shard) in &unacknowledged {
            deliver(world, number, process, &connection, *lease, shard);
        }
        let (mut credit, mut heartbeat) = (0, Instant::now());
        loop {
            sleep(TICK).await;
            if own.killed.get() {
                return false;
            }
            if Instant::now() < own.frozen.get() {
                continue;
            }
            if own.cut.get() || connection.up.is_closed() {
                break;
            }
            let mut ended = None;
            loop {
                match connection.down.try_recv() {
                    Ok(Ok(v1::RolloutResponse { message: Some(Response::Lease(lease)) })) => {
                        credit -= 1;
                        let shard = read_shard("lease.shard", lease.shard.as_ref()).unwrap();
                        if own.refuses.get() {
                            say(&connection, failed(lease.lease_id));
                        } else {
                            let (lease, asked) = (lease.lease_id, Instant::now());
                            jobs.push(Job { lease, shard, asked, done: None });
                        }
                    }
                    Ok(Ok(v1::RolloutResponse { message: Some(Response::Ack(ack)) })) => {
                        assert_ne!(ack.verdict(), v1::Verdict::Rejected, "seed {}: {}", world.seed, ack.reason);
                        unacknowledged.remove(&ack.lease_id);
                    }
                    Ok(Ok(_)) => {}
                    Ok(Err(status)) => ended = Some(status),
                    Err(mpsc::error::TryRecvError::Empty) => break,
                    Err(mpsc::error::TryRecvError::Disconnected) => {
                        ended.get_or_insert_with(|| Status::unavailable("gone"));
                        break;
                    }
                }
            }
            if let Some(status) = ended {
                use tonic::Code::{FailedPrecondition, InvalidArgument};
                if matches!(status.code(), InvalidArgument | FailedPrecondition) {
                    assert!(world.liars.borrow().contains(&process), "seed {}: evicted: {status}", world.seed);
                    return true;
                }
                break;
            }
            work(world, number, process, &connection, (&mut jobs, &mut unacknowledged), random);
            let wanted = threads.saturating_sub(jobs.len() + credit);
            if wanted > 0 && unacknowledged.len() <= 2 * threads {
                credit += wanted;
                say(&connection, Request::Ready(v1::Ready { credit: wanted as u32 }));
            }
            if heartbeat.elapsed() >= LEASE / 4 {
                heartbeat = Instant::now();
                say(&connection, Request::Heartbeat(v1::Heartbeat {}));
            }
        }
    }
}

/// One step of the rollout threads.
fn work(
    world: &Rc<World>,
    number: usize,
    process: u64,
    connection: &Connection,
    (jobs, unacknowledged): (&mut Vec<Job>, &mut BTreeMap<u64, Shard>),
    random: &mut Stream,
) {
    let (own, now) = (&world.actors[number], Instant::now());
    if own.hung.get() {
        return;
    }
    let reachable = !own.no_commander.get() && !world.commander_away.get();
    for job in jobs.iter_mut().filter(|job| job.done.is_none() && reachable) {
        job.done = Some(now + Duration::from_millis(100) + up_to(random, 300));
    }
    let late: Vec<Job> = jobs.extract_if(.., |job| job.done.is_none() && job.asked.elapsed() >= LEASE).collect();
    late.iter().for_each(|job| say(connection, failed(job.lease)));
    for job in jobs.extract_if(.., |job| job.done.is_some_and(|done| now >= done)) {
        deliver(world, number, process, connection, job.lease, &job.shard);
        unacknowledged.insert(job.lease, job.shard);
    }
}

fn failed(lease_id: u64) -> Request {
    Request::Failed(v1::Failed { lease_id, shard: None, reason: "no commander".into(), retryable: true })
}

fn say(connection: &Connection, message: Request) {
    // A connection that takes nothing more is about to end.
    let _ = connection.up.try_send(v1::RolloutRequest { message: Some(message) });
}

fn deliver(world: &World, number: usize, process: u64, connection: &Connection, lease_id: u64, shard: &Shard) {
    let lie = world.actors[number].lies.get();
    if lie && !world.liars.borrow().contains(&process) {
        world.liars.borrow_mut().push(process);
    }
    let key = (shard.iteration.0, shard.index, shard.kind == ShardKind::Eval, lie);
    let encode = || encode_result(&run_id(), &weights(shard.version.0).sha256, &result(shard, lie));
    let bytes = world.encoded.borrow_mut().entry(key).or_insert_with(encode).clone();
    for part in parts::split(bytes) {
        say(connection, Request::Part(v1::ResultPart { lease_id, part: Some(part), timing: None }));
    }
}

/// Connects to the learner that is there, if there is one and the wire carries anything.
async fn connect(world: &Rc<World>, number: usize, process: u64, random: &mut Stream) -> Option<Connection> {
    let own = &world.actors[number];
    sleep(Duration::from_millis(50) + up_to(random, 200)).await;
    let learner = world.learner();
    let now = Instant::now();
    if own.killed.get() || learner.gone.is_cancelled() || now < own.silent_wire.get() || now < own.frozen.get() {
        return None;
    }
    let (up, from_actor) = mpsc::channel(256);
    let (to_learner, inbound) = mpsc::channel(256);
    let (outbound, from_learner) = mpsc::channel(64);
    let (to_actor, down) = mpsc::channel(256);
    let hello = v1::Hello {
        protocol_version: PROTOCOL_VERSION,
        actor_id: format!("actor-{number}"),
        process_id: process,
        threads: 1,
        ..Default::default()
    };
    let hello = v1::RolloutRequest { message: Some(Request::Hello(hello)) };
    let seeds = [random.below(1 << 31), random.below(1 << 31)];
    let up_wire = upward(world.clone(), number, from_actor, to_learner, world.stream(&[4, seeds[0]]));
    let down_wire = downward(world.clone(), number, from_learner, to_actor, world.stream(&[5, seeds[1]]));
    let session = serve_stream(learner.shared.clone(), hello, ReceiverStream::new(inbound), outbound);
    let Process { gone, .. } = learner;
    tokio::task::spawn_local(async move {
        let both_ways = async { tokio::join!(up_wire, down_wire, session) };
        gone.run_until_cancelled(both_ways).await;
    });
    Some(Connection { up, down })
}

fn delay(random: &mut Stream) -> Duration {
    let most = if random.below(50) == 0 { 400 } else { 15 };
    up_to(random, most)
}

/// Results may arrive twice, and after what was said later.
async fn upward(
    world: Rc<World>,
    number: usize,
    mut from: mpsc::Receiver<v1::RolloutRequest>,
    to: mpsc::Sender<Result<v1::RolloutRequest, Status>>,
    mut random: Stream,
) {
    let mut held: Option<v1::RolloutRequest> = None;
    while let Some(message) = from.recv().await {
        sleep(delay(&mut random)).await;
        if Instant::now() < world.actors[number].silent_wire.get() {
            continue;
        }
        let result = matches!(message.message, Some(Request::Part(_)));
        if result && held.is_none() && random.below(10) == 0 {
            held = Some(message);
            continue;
        }
        let copies = if result && random.below(10) == 0 { 2 } else { 1 };
        for _ in 0..copies {
            if to.send(Ok(message.clone())).await.is_err() {
                return;
            }
        }
        if let Some(held) = held.take() {
            let _ = to.send(Ok(held)).await;
        }
    }
}

async fn downward(
    world: Rc<World>,
    number: usize,
    mut from: mpsc::Receiver<Result<v1::RolloutResponse, Status>>,
    to: mpsc::Sender<Result<v1::RolloutResponse, Status>>,
    mut random: Stream,
) {
    while let Some(message) = from.recv().await {
        sleep(delay(&mut random)).await;
        if Instant::now() >= world.actors[number].silent_wire.get() && to.send(message).await.is_err() {
            return;
        }
    }
}
