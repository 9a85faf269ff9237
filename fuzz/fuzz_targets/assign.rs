//! Bytes from the wire to the answer: a valid matching, or an error that names a field.
//! `cargo +nightly fuzz run assign` in this folder's parent.
#![no_main]

use libfuzzer_sys::fuzz_target;
use magex_dispatch::{DispatchError, Limits, Problem, answer, engine};
use magex_proto::v1::AssignRequest;
use prost::Message as _;

fuzz_target!(|bytes: &[u8]| {
    let Ok(message) = AssignRequest::decode(bytes) else { return };
    let limits = Limits { members: 64, teams: 1 };
    let problem = match Problem::read(message, 1, &limits) {
        Ok(problem) => problem,
        Err(error) => return assert!(!error.field.is_empty() && !error.problem.is_empty()),
    };
    let plan = match engine::solve(&problem, problem.scheduler, &|| true) {
        Ok(plan) => plan,
        Err(DispatchError::Invalid(error)) => panic!("a problem that was read was refused: {error}"),
        Err(DispatchError::Interrupted) => panic!("nobody interrupted it"),
    };
    let response = answer::write(&problem, &plan);
    let mut free = vec![true; problem.goal_count];
    for pair in &response.pairs {
        assert!(std::mem::take(&mut free[pair.goal_index as usize]));
        assert!(!problem.forbidden.contains(&(pair.agent_index, pair.goal_index)));
        assert!(pair.cost.is_finite() && pair.distance.is_finite());
    }
    assert_eq!(response.pairs.len() + response.agents_without_goal.len(), problem.agent_count);
    assert_eq!(response.pairs.len() + response.goals_without_agent.len(), problem.goal_count);
});
