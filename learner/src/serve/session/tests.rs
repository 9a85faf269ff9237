use super::*;
use crate::fixtures;
use crate::run_identity::RunIdentity;
use crate::serve::judge::Judge;
use crate::serve::validate::Limits;
use crate::serve::weights_board::Weights;
use bytes::Bytes;
use magex_core::ids::{RunId, Shard, WeightsVersion};
use std::time::Duration;
use tokio_stream::wrappers::ReceiverStream;

fn shared(lease: Duration) -> Arc<Shared> {
    let run = RunIdentity {
        run_id: RunId("run".into()),
        name: "test".into(),
        task_fingerprint: fixtures::task().fingerprint(),
        run_config_toml: String::new(),
        seed: 7,
        lease,
    };
    Arc::new(Shared::new(run, Limits::for_task(&fixtures::task(), 2)))
}

/// An actor after its handshake, and the messages it receives.
fn session(shared: &Arc<Shared>) -> (Session, mpsc::Receiver<Result<v1::RolloutResponse, Status>>) {
    session_of(shared, "a", 0)
}

fn session_of(
    shared: &Arc<Shared>,
    name: &str,
    process_id: u64,
) -> (Session, mpsc::Receiver<Result<v1::RolloutResponse, Status>>) {
    let (outbound, heard) = mpsc::channel(4096);
    let protocol_version = PROTOCOL_VERSION;
    let hello = v1::Hello { protocol_version, actor_id: name.into(), process_id, ..Default::default() };
    let first = v1::RolloutRequest { message: Some(Request::Hello(hello)) };
    let (id, hello) = handshake(shared, "here".into(), first, &outbound).unwrap();
    (Session::new(shared.clone(), id, hello, outbound), heard)
}

fn ready(credit: u32) -> v1::RolloutRequest {
    v1::RolloutRequest { message: Some(Request::Ready(v1::Ready { credit })) }
}

fn publish(shared: &Shared) {
    shared.publish(Arc::new(Weights::new(RunId("run".into()), WeightsVersion(0), Bytes::new())));
}

fn plan(shards: u32) -> Vec<Shard> {
    (0..shards).map(|index| fixtures::train_shard(0, index, 2)).collect()
}

/// Messages that have arrived already, on a stream that stays open.
async fn arrived(
    messages: Vec<v1::RolloutRequest>,
) -> (mpsc::Sender<Result<v1::RolloutRequest, Status>>, ReceiverStream<Result<v1::RolloutRequest, Status>>) {
    let (sender, inbound) = mpsc::channel(messages.len().max(1));
    for message in messages {
        sender.send(Ok(message)).await.unwrap();
    }
    (sender, ReceiverStream::new(inbound))
}

#[tokio::test]
async fn messages_that_have_arrived_count_before_the_deadline() {
    // The deadline has passed whenever it is checked.
    let shared = shared(Duration::from_nanos(1));
    let (mut session, _heard) = session(&shared);
    let (_open, inbound) = arrived(vec![ready(1); 100]).await;
    assert!(matches!(session.run_loop(inbound).await, SessionEnd::Silent));
    assert_eq!(session.credit, 100);
}

#[tokio::test]
async fn time_that_the_learner_spends_is_not_silence_of_the_actor() {
    let lease = Duration::from_millis(200);
    let shared = shared(lease);
    publish(&shared);
    let (mut session, _heard) = session(&shared);
    // Returning a lease waits for the ledger for longer than a lease.
    let failed = v1::Failed { lease_id: 1, retryable: true, ..Default::default() };
    let (_open, inbound) = arrived(vec![v1::RolloutRequest { message: Some(Request::Failed(failed)) }]).await;
    let busy = shared.clone();
    let (held, holds) = std::sync::mpsc::channel();
    let holder = std::thread::spawn(move || {
        busy.work.with_ledger(|_| {
            held.send(()).unwrap();
            std::thread::sleep(2 * lease);
        });
        Instant::now()
    });
    holds.recv().unwrap();
    assert!(matches!(session.run_loop(inbound).await, SessionEnd::Silent));
    let since = holder.join().unwrap().elapsed();
    assert!(since >= lease * 3 / 4, "{since:?} after the learner had time again");
}

#[tokio::test]
async fn credit_in_many_messages_is_no_more_than_credit_in_one() {
    let shared = shared(Duration::from_millis(100));
    publish(&shared);
    shared.work.open(plan(4 * MAX_LEASES as u32)).unwrap();
    let (mut session, _heard) = session(&shared);
    let (_open, inbound) = arrived(vec![ready(MAX_LEASES as u32); 3]).await;
    assert!(matches!(session.run_loop(inbound).await, SessionEnd::Silent));
    assert_eq!(shared.work.with_ledger(|ledger| ledger.leases_of(session.id)), MAX_LEASES);
}

#[tokio::test]
async fn a_damaged_result_takes_its_lease_with_it() {
    let shared = shared(Duration::from_millis(50));
    publish(&shared);
    shared.work.open(plan(1)).unwrap();
    let (mut session, mut heard) = session(&shared);
    session.credit = 1;
    session.grant_leases().await.unwrap();
    let lease = match heard.recv().await.unwrap().unwrap().message {
        Some(Response::Lease(lease)) => lease.lease_id,
        other => panic!("expected a lease, not {other:?}"),
    };
    let part = v1::Part { index: 0, total: 1, total_bytes: 1, crc32c: 1, data: Bytes::from_static(b"x") };
    let message = v1::ResultPart { lease_id: lease, part: Some(part), timing: None };
    session.on_message(Request::Part(message)).await.unwrap();
    assert_eq!((session.damaged, session.granted.len()), (1, 0));
}

/// Leases a shard and fails it permanently; whether the actor stays.
fn fail(session: &mut Session) -> bool {
    let asker = Asker { session: session.id, process: session.process_id, now: Instant::now() };
    let lease = session.shared.work.with_ledger(|ledger| ledger.lease(asker, Vec::new)).unwrap();
    let failed = v1::Failed { lease_id: lease.id.0, reason: "no luck".into(), ..Default::default() };
    session.on_failed(&failed).is_ok()
}

#[tokio::test]
async fn of_several_failing_actors_one_stays_and_the_failing_shard_is_given_up() {
    let shared = shared(Duration::from_secs(15));
    publish(&shared);
    shared.work.open(plan(3)).unwrap();
    let (mut a, _a) = session_of(&shared, "a", 1);
    let (mut b, _b) = session_of(&shared, "b", 2);
    for _ in 0..2 {
        assert!(fail(&mut a) && fail(&mut b));
    }
    // The session of an evicted actor has not ended yet, and both fail at once.
    let stays = (fail(&mut a), fail(&mut b));
    assert_eq!(stays, (false, true));
    assert_eq!(shared.roster.connected_processes(), [2]);
    for _ in 0..3 {
        assert!(fail(&mut b), "the last actor is not evicted");
    }
    let error = shared.wait(&mut Judge::default()).unwrap_err();
    assert!(error.to_string().contains("no luck"), "{error}");
}
