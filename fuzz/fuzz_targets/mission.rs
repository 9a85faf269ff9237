//! A mission from bytes, updates from bytes: it stays valid, and its record can be read back.
//! `cargo +nightly fuzz run mission` in this folder's parent.
#![no_main]

use libfuzzer_sys::fuzz_target;
use magex_dispatch::engine;
use magex_dispatch::mission::{Mission, MissionLimits, Planned};
use magex_dispatch::{DispatchError, Problem};
use magex_proto::v1::{CreateMissionRequest, UpdateMissionRequest};
use prost::Message as _;

fn planner(problem: &Problem) -> Result<Planned, DispatchError> {
    let plan = engine::solve(problem, problem.scheduler, &|| true)?;
    Ok(Planned { plan, fallback_reason: String::new(), weights: None })
}

fuzz_target!(|bytes: &[u8]| {
    let limits = MissionLimits { members: 16, lifetime_ms: 1000 };
    // Requests are parted by their length in one byte.
    let mut rest = bytes;
    let mut next = || {
        let (&length, tail) = rest.split_first()?;
        let (part, after) = tail.split_at_checked(usize::from(length)).unwrap_or((tail, &[]));
        rest = after;
        Some(part)
    };
    let Some(Ok(request)) = next().map(CreateMissionRequest::decode) else { return };
    let Ok(mut mission) = Mission::create(request, "me", "drawn", 0, &limits, &planner) else { return };
    while let Some(part) = next() {
        let Ok(request) = UpdateMissionRequest::decode(part) else { continue };
        match mission.update(request, 1, &limits, &planner) {
            Ok(updated) => mission = updated,
            Err(DispatchError::Invalid(error)) => assert!(!error.field.is_empty()),
            Err(DispatchError::Interrupted) => panic!("nobody interrupted it"),
        }
        let a = &mission.assignment;
        assert_eq!(a.pairs.len() + a.agents_without_goal.len(), a.agents.len());
        assert_eq!(Mission::decode(&mission.encode()).map(|m| m.encode()), Ok(mission.encode()));
    }
});
