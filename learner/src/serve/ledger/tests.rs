use super::*;
use magex_core::ids::{Iteration, Mode, ShardKind, WeightsVersion};
use magex_core::trajectory::EvalOutcome;
use proptest::prelude::*;

const A: SessionId = SessionId(1);
const B: SessionId = SessionId(2);

fn shard(iteration: u32, index: u32) -> Shard {
    Shard {
        kind: ShardKind::Eval,
        iteration: Iteration(iteration),
        index,
        episodes: 1 + index % 3,
        first_episode: 3 * index,
        version: WeightsVersion(iteration),
        mode: Mode::Greedy,
        eval_set: 1,
        record: false,
    }
}

fn plan(iteration: u32, shards: u32) -> Vec<Shard> {
    (0..shards).map(|index| shard(iteration, index)).collect()
}

fn result(shard: Shard) -> ShardResult {
    ShardResult::Eval(EvalOutcome { shard, metrics: Vec::new(), recording: None })
}

const LEASE: Duration = Duration::from_secs(10);

/// A ledger that has nothing computed twice.
fn ledger(first_lease: u64) -> Ledger {
    Ledger::new(first_lease, LEASE, Sampling { key: 1, share: 0.0 })
}

/// A result of a process that has the number of its session; all processes give the same.
fn origin(session: SessionId) -> (Origin, Instant) {
    (Origin { actor: "a".into(), process: session.0, digest: "same".into() }, Instant::now())
}

impl Ledger {
    /// Of the only actor with room.
    fn next(&mut self, session: SessionId) -> Option<Lease> {
        self.lease(Asker { session, process: session.0, now: Instant::now() }, Vec::new)
    }
}

fn opened(shards: u32) -> Ledger {
    let mut ledger = ledger(100);
    ledger.open(plan(0, shards)).unwrap();
    ledger
}

#[test]
fn results_come_out_in_the_order_of_the_plan() {
    let mut ledger = opened(3);
    let leases: Vec<Lease> = (0..3).map(|_| ledger.next(A).unwrap()).collect();
    assert!(ledger.next(B).is_none());
    for lease in [leases[2], leases[0], leases[1]] {
        assert!(ledger.take().is_none());
        assert_eq!(ledger.complete(A, lease.id, result(lease.shard), origin(A)), Ok(Verdict::Accepted));
    }
    let order: Vec<u32> = ledger.take().unwrap().iter().map(|(result, _)| result.shard().index).collect();
    assert_eq!(order, [0, 1, 2]);
    assert!(ledger.take().is_none() && ledger.progress() == (0, 0));
}

#[test]
fn the_leases_of_a_lost_actor_come_next_and_in_order() {
    let mut ledger = opened(4);
    ledger.next(A).unwrap();
    ledger.next(A).unwrap();
    assert_eq!(ledger.drop_actor(A), 2);
    let order: Vec<u32> = std::iter::from_fn(|| ledger.next(B)).map(|lease| lease.shard.index).collect();
    assert_eq!(order, [0, 1, 2, 3]);
    assert_eq!(ledger.counters(), Counters { leased: 6, expired: 2, outstanding: 4, ..Counters::default() });
    // Of 1, 2, 3 and 1 episodes.
    assert_eq!(ledger.episodes(), Counters { leased: 10, expired: 3, outstanding: 7, ..Counters::default() });
}

#[test]
fn the_late_result_of_a_lost_lease_counts_once() {
    let mut ledger = opened(1);
    let lost = ledger.next(A).unwrap();
    ledger.drop_actor(A);
    let again = ledger.next(B).unwrap();
    assert_eq!(ledger.complete(A, lost.id, result(lost.shard), origin(A)), Ok(Verdict::Accepted));
    assert_eq!(ledger.complete(B, again.id, result(again.shard), origin(B)), Ok(Verdict::Duplicate));
    assert_eq!(ledger.episodes().residual, 0);
    let counters = ledger.counters();
    assert_eq!((counters.leased, counters.trained, counters.duplicate, counters.expired), (3, 1, 1, 1));
    assert_eq!(counters.residual, 0);
}

#[test]
fn a_result_of_another_shard_than_the_leased_one_is_rejected_and_redone() {
    let mut ledger = opened(2);
    let lease = ledger.next(A).unwrap();
    assert!(ledger.complete(A, lease.id, result(shard(0, 1)), origin(A)).is_err());
    assert_eq!(ledger.next(A).unwrap().shard, lease.shard);
    assert_eq!(ledger.counters().residual, 0);
}

/// One attempt that fails for good, by an actor whose process has the number of its session.
fn fail(ledger: &mut Ledger, session: u64, actor: &str, connected: &[u64]) {
    let lease = ledger.next(SessionId(session)).unwrap();
    let failure = ShardFailure { actor, process: session, reason: "no such task", connected };
    assert!(ledger.fail(SessionId(session), lease.id, &failure));
}

#[test]
fn a_shard_that_may_succeed_is_not_given_up() {
    let mut ledger = opened(1);
    for _ in 0..10 {
        let lease = ledger.next(A).unwrap();
        ledger.give_back(A, lease.id);
    }
    assert_eq!(ledger.given_up(), None);
    assert_eq!((ledger.counters().failed, ledger.queued()), (10, 1));
}

#[test]
fn a_shard_is_given_up_that_three_different_actors_cannot_do() {
    let mut ledger = opened(1);
    // Others are there that have not tried.
    let present = [1, 2, 3, 4];
    for _ in 0..2 * MAX_FAILURES {
        fail(&mut ledger, 1, "a", &present);
    }
    fail(&mut ledger, 2, "b", &present);
    assert_eq!(ledger.given_up(), None, "two actors");
    fail(&mut ledger, 3, "c", &present);
    assert_eq!(ledger.given_up().unwrap().1, "no such task");
}

#[test]
fn a_restarted_actor_is_the_same_actor() {
    let mut ledger = opened(1);
    for process in 1..=2 * u64::from(MAX_FAILURES) {
        fail(&mut ledger, process, "broken", &[process, 100]);
    }
    assert_eq!(ledger.given_up(), None);
    assert_eq!(ledger.plan[0].failed_at.len(), 1, "those that are gone are forgotten");
}

#[test]
fn a_shard_is_given_up_after_every_connected_actor_failed_at_it() {
    let mut ledger = opened(1);
    for attempt in 1..=MAX_FAILURES {
        assert_eq!(ledger.given_up(), None, "attempt {attempt}");
        fail(&mut ledger, 1, "a", &[1]);
    }
    assert!(ledger.given_up().is_some(), "the only one");

    let mut ledger = opened(1);
    for _ in 0..MAX_FAILURES {
        fail(&mut ledger, 1, "replica", &[1, 2]);
    }
    assert_eq!(ledger.given_up(), None, "one of the same name has not tried");
    fail(&mut ledger, 2, "replica", &[1, 2]);
    assert!(ledger.given_up().is_some());
}

#[test]
fn a_failure_of_a_lease_that_is_held_no_more_says_nothing() {
    let mut ledger = opened(1);
    let lease = ledger.next(A).unwrap();
    ledger.drop_actor(A);
    let failure = ShardFailure { actor: "a", process: 1, reason: "x", connected: &[1] };
    for _ in 0..MAX_FAILURES {
        assert!(!ledger.fail(A, lease.id, &failure));
    }
    assert_eq!(ledger.given_up(), None);
}

#[test]
fn plans_that_make_no_sense_are_refused() {
    let mut ledger = ledger(0);
    assert!(matches!(ledger.open(Vec::new()), Err(CollectError::EmptyPlan)));
    assert!(matches!(ledger.open(vec![shard(1, 2), shard(1, 2)]), Err(CollectError::Repeated(2, 1))));
    ledger.open(plan(0, 2)).unwrap();
    assert!(matches!(ledger.open(plan(1, 2)), Err(CollectError::OpenPlan(0, 2))));
    ledger.abandon();
    ledger.open(plan(1, 2)).unwrap();
}

#[derive(Debug, Clone)]
enum Step {
    Lease(u64),
    Complete { actor: u64, lease: usize },
    Reject { actor: u64, lease: usize },
    Fail { actor: u64, lease: usize, retryable: bool },
    Drop(u64),
    Abandon,
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let pair = || (0u64..3, 0usize..40);
    let step = prop_oneof![
        6 => (0u64..3).prop_map(Step::Lease),
        6 => pair().prop_map(|(actor, lease)| Step::Complete { actor, lease }),
        1 => pair().prop_map(|(actor, lease)| Step::Reject { actor, lease }),
        1 => (pair(), any::<bool>()).prop_map(|((actor, lease), retryable)| Step::Fail { actor, lease, retryable }),
        1 => (0u64..3).prop_map(Step::Drop),
        1 => Just(Step::Abandon),
    ];
    prop::collection::vec(step, 0..200)
}

proptest! {
    /// Whatever happens: no lease is lost or counted twice, no shard is trained twice, and one good actor finishes the plan.
    #[test]
    fn every_lease_ends_once_and_every_plan_can_be_finished(steps in steps(), shards in 1u32..6) {
        let mut ledger = ledger(0);
        let mut iteration = 0;
        let mut seen: Vec<Lease> = Vec::new();
        let mut handed_out = 0;
        ledger.open(plan(0, shards)).unwrap();
        for step in steps {
            let pick = |lease: usize| seen.get(lease % seen.len().max(1)).copied();
            match step {
                Step::Lease(actor) => seen.extend(ledger.next(SessionId(actor))),
                Step::Complete { actor, lease } => if let Some(lease) = pick(lease) {
                    let _ = ledger.complete(SessionId(actor), lease.id, result(lease.shard), origin(SessionId(actor)));
                },
                Step::Reject { actor, lease } => if let Some(lease) = pick(lease) {
                    ledger.reject(SessionId(actor), lease.id);
                },
                Step::Fail { actor, lease, retryable } => if let Some(lease) = pick(lease) {
                    if retryable {
                        ledger.give_back(SessionId(actor), lease.id);
                    } else {
                        let failure = ShardFailure { actor: "x", process: actor, reason: "x", connected: &[0, 1, 2] };
                        ledger.fail(SessionId(actor), lease.id, &failure);
                    }
                },
                Step::Drop(actor) => {
                    ledger.drop_actor(SessionId(actor));
                    prop_assert_eq!(ledger.leases_of(SessionId(actor)), 0);
                }
                Step::Abandon => {
                    ledger.abandon();
                    iteration += 1;
                    ledger.open(plan(iteration, shards)).unwrap();
                }
            }
            prop_assert_eq!(ledger.counters().residual, 0);
            prop_assert_eq!(ledger.episodes().residual, 0);
            let (done, total) = ledger.progress();
            prop_assert!(done <= total);
            if let Some(results) = ledger.take() {
                handed_out += results.len() as u64;
                prop_assert!(results.iter().map(|(r, _)| *r.shard()).eq(plan(iteration, shards)));
                iteration += 1;
                ledger.open(plan(iteration, shards)).unwrap();
            }
        }
        for actor in 0..3 {
            ledger.drop_actor(SessionId(actor));
        }
        while let Some(lease) = ledger.next(SessionId(9)) {
            prop_assert_eq!(ledger.complete(SessionId(9), lease.id, result(lease.shard), origin(SessionId(9))), Ok(Verdict::Accepted));
        }
        let results = ledger.take();
        prop_assert_eq!(results.map(|r| r.len()), Some(shards as usize));
        prop_assert_eq!(ledger.counters().residual, 0);
        prop_assert_eq!(ledger.counters().outstanding, 0);
        prop_assert_eq!((ledger.episodes().residual, ledger.episodes().outstanding), (0, 0));
        prop_assert!(ledger.counters().trained >= handed_out + u64::from(shards));
    }
}

/// An actor that has room at this time.
fn asker(session: SessionId, now: Instant) -> Asker {
    Asker { session, process: session.0, now }
}

#[test]
fn while_nothing_is_known_of_durations_only_the_first_lease_is_waited_for_in_full() {
    let mut ledger = opened(1);
    let start = Instant::now();
    let mut lease = |session, now| ledger.lease(asker(session, now), Vec::new).map(|lease| lease.shard);
    let shard = lease(A, start).unwrap();
    assert_eq!(lease(B, start + LEASE * 9 / 10), None);
    assert_eq!(lease(B, start + LEASE), Some(shard));
    // The second one does not answer either.
    assert_eq!(lease(SessionId(3), start + LEASE * 11 / 10), None);
    assert_eq!(lease(SessionId(3), start + LEASE * 5 / 4), Some(shard));
    assert_eq!(lease(SessionId(4), start + LEASE * 3 / 2), Some(shard));
}

#[test]
fn a_lease_that_is_lost_counts_among_those_that_were_waited_for() {
    let mut ledger = opened(1);
    let start = Instant::now();
    let shard = ledger.lease(asker(A, start), Vec::new).unwrap().shard;
    assert!(ledger.lease(asker(B, start + LEASE), Vec::new).is_some());
    ledger.drop_actor(A);
    assert_eq!(ledger.lease(asker(SessionId(3), start + LEASE * 11 / 10), Vec::new), None);
    let third = ledger.lease(asker(SessionId(3), start + LEASE * 5 / 4), Vec::new);
    assert_eq!(third.map(|lease| lease.shard), Some(shard));
}

#[test]
fn a_late_shard_is_leased_once_more_and_the_first_result_counts() {
    let mut ledger = opened(2);
    let start = Instant::now();
    let [first, second] = [A, B].map(|session| ledger.lease(asker(session, start), Vec::new).unwrap());
    assert_eq!(ledger.lease(asker(B, start + LEASE / 2), Vec::new), None, "nothing is known of durations yet");
    assert_eq!(
        ledger.complete(B, second.id, result(second.shard), (origin(B).0, start + LEASE / 10)),
        Ok(Verdict::Accepted)
    );
    // Shards of this kind take a tenth of a lease, as far as is known.
    assert_eq!(ledger.next_late(B.0), Some(start + LEASE / 5));
    assert_eq!(ledger.next_late(A.0), None, "it holds the shard");
    assert_eq!(ledger.lease(asker(B, start + LEASE / 6), Vec::new), None);
    assert_eq!(ledger.lease(asker(A, start + LEASE), Vec::new), None, "not to the process that has it");
    let again = ledger.lease(asker(B, start + LEASE / 5), Vec::new).unwrap();
    assert_eq!(again.shard, first.shard);
    assert_eq!(ledger.lease(asker(SessionId(3), start + LEASE / 4), Vec::new), None, "the second lease is not late");
    assert_eq!(ledger.complete(B, again.id, result(again.shard), origin(B)), Ok(Verdict::Accepted));
    assert_eq!(ledger.complete(A, first.id, result(first.shard), origin(A)), Ok(Verdict::Duplicate));
    let counters = ledger.counters();
    assert_eq!((counters.leased, counters.trained, counters.duplicate, counters.residual), (3, 2, 1, 0));
    assert!(ledger.take().is_some());
}

#[test]
fn a_shard_that_was_given_back_goes_to_another_with_room_first() {
    let mut ledger = opened(1);
    let now = Instant::now();
    let lease = ledger.lease(asker(A, now), Vec::new).unwrap();
    assert!(ledger.give_back(A, lease.id));
    assert_eq!(ledger.lease(asker(A, now), || vec![B.0]), None, "B has room");
    let lease = ledger.lease(asker(B, now), || vec![A.0]).unwrap();
    assert!(ledger.give_back(B, lease.id));
    assert!(ledger.lease(asker(A, now), || vec![B.0]).is_some(), "both gave it back");
}

/// A result with a digest of its own.
fn sent(session: SessionId, digest: &str) -> (Origin, Instant) {
    (Origin { digest: digest.into(), ..origin(session).0 }, Instant::now())
}

fn checking(shards: u32, share: f64) -> Ledger {
    let mut ledger = Ledger::new(0, LEASE, Sampling { key: 3, share });
    ledger.open(plan(0, shards)).unwrap();
    ledger
}

#[test]
fn a_newcomers_result_is_computed_again_by_another_and_the_plan_does_not_wait_for_it() {
    let mut ledger = checking(1, 1e-9);
    let lease = ledger.next(A).unwrap();
    assert_eq!(ledger.complete(A, lease.id, result(lease.shard), sent(A, "x")), Ok(Verdict::Accepted));
    assert_eq!(ledger.next(A), None, "no process confirms its own results");
    let check = ledger.next(B).unwrap();
    assert_eq!(check.shard, lease.shard);
    assert!(ledger.take().is_some(), "the plan is complete");
    // The next one does wait: the weights of the check are gone after it.
    ledger.open(plan(1, 1)).unwrap();
    let next = ledger.next(B).unwrap();
    ledger.complete(B, next.id, result(next.shard), sent(B, "y")).unwrap();
    assert!(ledger.all_done() && ledger.take().is_none());
    assert_eq!(ledger.complete(B, check.id, result(check.shard), sent(B, "x")), Ok(Verdict::Duplicate));
    assert_eq!(ledger.checks.take_confirmed(), [(A.0, lease.shard)]);
    assert!(ledger.take().is_some());
    assert_eq!((ledger.counters().residual, ledger.checks.totals.same), (0, 1));
}

#[test]
fn results_that_differ_are_a_case_for_the_learners_host() {
    let mut ledger = checking(1, 1e-9);
    let lease = ledger.next(A).unwrap();
    ledger.complete(A, lease.id, result(lease.shard), sent(A, "wrong")).unwrap();
    let now = Instant::now();
    assert!(ledger.checks.case(&[A.0, B.0], |_| None, now).is_none(), "B can compute it");
    assert!(ledger.checks.case(&[A.0], |_| None, now).is_some(), "no other actor is there");
    assert!(ledger.checks.case(&[A.0, B.0], |_| Some(Duration::ZERO), now).is_some(), "and no other actor has done it");
    let check = ledger.next(B).unwrap();
    ledger.complete(B, check.id, result(check.shard), sent(B, "right")).unwrap();
    let case = ledger.checks.case(&[A.0, B.0], |_| None, now).unwrap();
    let wrong = ledger.checks.decide(&case.shard, Some("right"));
    assert_eq!(wrong.iter().map(|origin| origin.process).collect::<Vec<_>>(), [A.0]);
    assert_eq!(ledger.checks.take_confirmed(), [(B.0, lease.shard)]);
}

#[test]
fn a_late_second_result_confirms_or_accuses_without_a_check() {
    for (digest, accused) in [("same", false), ("other", true)] {
        let mut ledger = checking(1, 0.0);
        let now = Instant::now();
        let slow = ledger.lease(asker(A, now), Vec::new).unwrap();
        let quick = ledger.lease(asker(B, now + LEASE), Vec::new).unwrap();
        ledger.complete(B, quick.id, result(quick.shard), sent(B, "same")).unwrap();
        ledger.complete(A, slow.id, result(slow.shard), sent(A, digest)).unwrap();
        assert_eq!(ledger.checks.case(&[A.0, B.0], |_| None, now).is_some(), accused);
        assert_eq!(ledger.checks.take_confirmed().len(), usize::from(!accused));
    }
}

/// Shards of a process that computes wrongly after its 1,000th until it is found, with two honest ones beside it.
fn found_after(key: u64) -> u32 {
    let mut ledger = Ledger::new(0, LEASE, Sampling { key, share: 0.01 });
    let mut order = magex_core::rng::Key::new(key, magex_core::rng::Purpose::Bench, &[]).stream();
    let mut made = 0;
    for iteration in 0.. {
        ledger.open(plan(iteration, 12)).unwrap();
        // Checks go over into the next plan, as in a run.
        while !ledger.is_complete() {
            let session = SessionId(1 + u64::from(order.below(3)));
            let Some(lease) = ledger.next(session) else { continue };
            made += u32::from(session == A);
            let digest = if session == A && made > 1000 { "wrong" } else { "right" };
            ledger.complete(session, lease.id, result(lease.shard), sent(session, digest)).unwrap();
            if ledger.checks.case(&[1, 2, 3], |_| None, Instant::now()).is_some() {
                return made - 1000;
            }
        }
        ledger.take().unwrap();
    }
    unreachable!("the loop has no end")
}

#[test]
fn an_actor_that_begins_to_compute_wrongly_is_found_within_300_shards_in_19_of_20_cases() {
    let mut shards: Vec<u32> = (1..=400).map(found_after).collect();
    shards.sort_unstable();
    let at = |share: f64| shards[(share * shards.len() as f64) as usize];
    println!("found after {} shards in half of the cases, {} in 95 %, {} in 99 %", at(0.5), at(0.95), at(0.99));
    assert!(at(0.95) <= 300, "{shards:?}");
}
