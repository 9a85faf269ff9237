use super::*;
use crate::fixtures;
use crate::run_identity::RunIdentity;
use crate::serve::validate::Limits;
use crate::serve::weights_board::Weights;
use bytes::Bytes;
use magex_core::ids::{RunId, Shard, WeightsVersion};
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

/// An actor that has been greeted, and what it will hear.
fn session(shared: &Arc<Shared>) -> (Session, mpsc::Receiver<Result<v1::RolloutResponse, Status>>) {
    session_of(shared, "a", 0)
}

fn session_of(
    shared: &Arc<Shared>,
    name: &str,
    incarnation: u64,
) -> (Session, mpsc::Receiver<Result<v1::RolloutResponse, Status>>) {
    let (outbound, heard) = mpsc::channel(4096);
    let protocol_version = PROTOCOL_VERSION;
    let hello = v1::Hello { protocol_version, actor_id: name.into(), incarnation, ..Default::default() };
    let first = v1::RolloutRequest { message: Some(Request::Hello(hello)) };
    let (id, hello) = greet(shared, "here".into(), first, &outbound).unwrap();
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

/// Messages that are there already, on a stream that stays open.
async fn said(
    messages: Vec<v1::RolloutRequest>,
) -> (mpsc::Sender<Result<v1::RolloutRequest, Status>>, ReceiverStream<Result<v1::RolloutRequest, Status>>) {
    let (say, inbound) = mpsc::channel(messages.len().max(1));
    for message in messages {
        say.send(Ok(message)).await.unwrap();
    }
    (say, ReceiverStream::new(inbound))
}

#[tokio::test]
async fn what_has_been_said_is_heard_before_an_actor_counts_as_silent() {
    // Every look at the clock is too late.
    let shared = shared(Duration::from_nanos(1));
    let (mut session, _heard) = session(&shared);
    let (_open, inbound) = said(vec![ready(1); 100]).await;
    assert!(matches!(session.talk(inbound).await, End::Silent));
    assert_eq!(session.credit, 100);
}

#[tokio::test]
async fn the_time_that_the_learner_takes_is_not_the_silence_of_the_actor() {
    let lease = Duration::from_millis(200);
    let shared = shared(lease);
    publish(&shared);
    let (mut session, _heard) = session(&shared);
    // Handing back waits for the ledger for longer than a lease.
    let failed = v1::Failed { lease_id: 1, retryable: true, ..Default::default() };
    let (_open, inbound) = said(vec![v1::RolloutRequest { message: Some(Request::Failed(failed)) }]).await;
    let busy = shared.clone();
    let (held, holds) = std::sync::mpsc::channel();
    let holder = std::thread::spawn(move || {
        busy.with_ledger(|_| {
            held.send(()).unwrap();
            std::thread::sleep(2 * lease);
        });
        Instant::now()
    });
    holds.recv().unwrap();
    assert!(matches!(session.talk(inbound).await, End::Silent));
    let since = holder.join().unwrap().elapsed();
    assert!(since >= lease * 3 / 4, "{since:?} after the learner had time again");
}

#[tokio::test]
async fn credit_in_many_messages_is_no_more_than_credit_in_one() {
    let shared = shared(Duration::from_millis(100));
    publish(&shared);
    shared.open(plan(4 * MAX_LEASES as u32)).unwrap();
    let (mut session, _heard) = session(&shared);
    let (_open, inbound) = said(vec![ready(MAX_LEASES as u32); 3]).await;
    assert!(matches!(session.talk(inbound).await, End::Silent));
    assert_eq!(shared.with_ledger(|ledger| ledger.leases_of(session.id)), MAX_LEASES);
}

#[tokio::test]
async fn a_damaged_result_takes_its_lease_with_it() {
    let shared = shared(Duration::from_millis(50));
    publish(&shared);
    shared.open(plan(1)).unwrap();
    let (mut session, mut heard) = session(&shared);
    session.credit = 1;
    session.hand_out().await.unwrap();
    let lease = match heard.recv().await.unwrap().unwrap().message {
        Some(Response::Lease(lease)) => lease.lease_id,
        other => panic!("a lease was due, not {other:?}"),
    };
    let part = v1::Part { index: 0, total: 1, total_bytes: 1, crc32c: 1, data: Bytes::from_static(b"x") };
    let message = v1::ResultPart { lease_id: lease, part: Some(part), timing: None };
    session.hear(Request::Part(message)).await.unwrap();
    assert_eq!((session.damaged, session.handed.len()), (1, 0));
}

/// Leases a shard and gives it back for good; whether it may stay.
fn fail(session: &mut Session) -> bool {
    let lease = session.shared.with_ledger(|ledger| ledger.lease(session.id)).unwrap();
    let failed = v1::Failed { lease_id: lease.id.0, reason: "no luck".into(), ..Default::default() };
    session.take_back(&failed).is_ok()
}

#[tokio::test]
async fn of_several_that_can_do_nothing_one_stays_and_finds_the_shard_that_nobody_can_do() {
    let shared = shared(Duration::from_secs(15));
    publish(&shared);
    shared.open(plan(3)).unwrap();
    let (mut a, _a) = session_of(&shared, "a", 1);
    let (mut b, _b) = session_of(&shared, "b", 2);
    for _ in 0..2 {
        assert!(fail(&mut a) && fail(&mut b));
    }
    // The connection of whoever is told to go has not ended yet, and both fail at once.
    let stays = (fail(&mut a), fail(&mut b));
    assert_eq!(stays, (false, true));
    assert_eq!(shared.present(), [2]);
    for _ in 0..3 {
        assert!(fail(&mut b), "the last one is not sent away");
    }
    let error = shared.wait().unwrap_err();
    assert!(error.to_string().contains("no luck"), "{error}");
}
