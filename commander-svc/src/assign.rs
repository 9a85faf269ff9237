//! One team of an outside client: reading the request, answering it, falling back. No network.

use crate::classical;
use crate::scheduler::{AssignError, Scheduler, SchedulerKind, TeamReply, TeamRequest};
use magex_core::ids::Mode;
use magex_proto::convert::ConvertError;
use magex_proto::{arrays, v1};

/// Agents or goals of one team.
pub(crate) const MAX_POINTS: usize = 5000;

/// Pairs that the learned scheduler looks at in one request; larger teams are answered exactly, and the answer says so.
const MAX_LEARNED_PAIRS: usize = 1_000_000;

/// A request that was read.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Team {
    pub(crate) request: TeamRequest,
    pub(crate) scheduler: SchedulerKind,
    agent_ids: Vec<String>,
    goal_ids: Vec<String>,
}

/// Checks a request; `seed` is used when it has none of its own.
pub(crate) fn read(message: v1::AssignRequest, seed: u64) -> Result<Team, ConvertError> {
    let scheduler = message.scheduler().into();
    let mode = match message.mode() {
        v1::Mode::Sampled => Mode::Sampled,
        v1::Mode::Greedy | v1::Mode::Unspecified => Mode::Greedy,
    };
    let (agents, agent_dims) = points("agents", message.agents)?;
    let (goals, dims) = points("goals", message.goals)?;
    if agent_dims != dims {
        return Err(ConvertError::new("goals", format!("{dims} dimensions, the agents have {agent_dims}")));
    }
    let (agent_count, goal_count) = (agents.len() / dims, goals.len() / dims);
    for (field, ids, count) in
        [("agent_ids", &message.agent_ids, agent_count), ("goal_ids", &message.goal_ids, goal_count)]
    {
        if !ids.is_empty() && ids.len() != count {
            return Err(ConvertError::new(
                field,
                format!("{} names for {count} points; give one each or none", ids.len()),
            ));
        }
    }
    let seed = message.seed.unwrap_or(seed);
    let request = TeamRequest { agent_count, goal_count, dims, agents, goals, mode, seed };
    Ok(Team { request, scheduler, agent_ids: message.agent_ids, goal_ids: message.goal_ids })
}

fn points(field: &str, positions: Option<v1::Positions>) -> Result<(Vec<f32>, usize), ConvertError> {
    let positions = positions.ok_or_else(|| ConvertError::missing(field))?;
    let (values, dims) = match positions.array {
        Some(array) => {
            let path = format!("{field}.array");
            let shape = arrays::shape_of(&path, Some(&array), 2)?;
            (arrays::to_f32(&path, Some(array), &shape)?, shape[1])
        }
        None => (positions.coordinates, positions.dims as usize),
    };
    if !(2..=3).contains(&dims) {
        return Err(ConvertError::new(format!("{field}.dims"), format!("{dims} is not 2 or 3")));
    }
    if values.is_empty() || !values.len().is_multiple_of(dims) {
        let problem = format!("{} numbers do not make points of {dims} coordinates", values.len());
        return Err(ConvertError::new(format!("{field}.coordinates"), problem));
    }
    if values.len() / dims > MAX_POINTS {
        return Err(ConvertError::new(field, format!("{} points are more than {MAX_POINTS}", values.len() / dims)));
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(place) => {
            let path = format!("{field}.coordinates[{place}]");
            Err(ConvertError::new(path, format!("{} is not finite", values[place])))
        }
        None => Ok((values, dims)),
    }
}

/// Asks the learned scheduler; its answer is a matching, or an error says why it is none.
pub(crate) fn ask_learned(team: &Team, scheduler: &dyn Scheduler) -> Result<TeamReply, AssignError> {
    let pairs = team.request.agent_count * team.request.goal_count;
    if pairs > MAX_LEARNED_PAIRS {
        return Err(AssignError::Unsupported(format!(
            "{pairs} pairs are more than the learned scheduler's {MAX_LEARNED_PAIRS}"
        )));
    }
    let reply = scheduler.assign_team(&team.request)?;
    check(&reply, &team.request).map_err(AssignError::Failed)?;
    Ok(reply)
}

/// Asks a scheduler that needs no training.
pub(crate) fn ask_classical(team: &Team, kind: SchedulerKind) -> Result<TeamReply, AssignError> {
    classical::assign_team(kind, &team.request)
}

fn check(reply: &TeamReply, request: &TeamRequest) -> Result<(), String> {
    let (n, g) = (request.agent_count, request.goal_count);
    if reply.goals.len() != n || reply.probabilities.as_ref().is_some_and(|p| p.len() != n) {
        return Err(format!("the model answered for {} agents of {n}", reply.goals.len()));
    }
    let mut taken = vec![false; g];
    for goal in reply.goals.iter().flatten() {
        match taken.get_mut(*goal as usize) {
            Some(taken) if !*taken => *taken = true,
            _ => return Err(format!("the model gave goal {goal} twice, or it does not exist")),
        }
    }
    let given = taken.iter().filter(|taken| **taken).count();
    if given != n.min(g) {
        return Err(format!("the model gave {given} goals where {} can be given", n.min(g)));
    }
    Ok(())
}

/// Writes the answer of one team with its costs. Names of scheduler and weights are the caller's.
pub(crate) fn write(team: &Team, reply: &TeamReply) -> Result<v1::AssignResponse, AssignError> {
    let (exact_cost, distances) = classical::exact_cost(&team.request)?;
    let g = team.request.goal_count;
    let name = |ids: &[String], index: usize| ids.get(index).cloned().unwrap_or_default();
    let mut response = v1::AssignResponse { exact_cost, ..Default::default() };
    let mut free = vec![true; g];
    for (agent, goal) in reply.goals.iter().enumerate() {
        let Some(goal) = goal.map(|goal| goal as usize) else {
            response.unassigned_agents.push(agent as u32);
            continue;
        };
        free[goal] = false;
        let distance = distances[agent * g + goal];
        response.cost += distance;
        response.pairs.push(v1::Pair {
            agent_index: agent as u32,
            goal_index: goal as u32,
            agent_id: name(&team.agent_ids, agent),
            goal_id: name(&team.goal_ids, goal),
            distance,
            probability: reply.probabilities.as_ref().and_then(|p| p.get(agent).copied()),
        });
    }
    response.unassigned_goals = (0..g as u32).filter(|&goal| free[goal as usize]).collect();
    response.gap = match exact_cost > 0.0 {
        // The sums are rounded in different orders.
        true => (response.cost / exact_cost - 1.0).max(0.0),
        false => 0.0,
    };
    Ok(response)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn positions(dims: u32, coordinates: &[f32]) -> Option<v1::Positions> {
        Some(v1::Positions { dims, coordinates: coordinates.to_vec(), array: None })
    }

    fn request(agents: &[f32], goals: &[f32]) -> v1::AssignRequest {
        v1::AssignRequest { agents: positions(2, agents), goals: positions(2, goals), ..Default::default() }
    }

    #[test]
    fn both_forms_of_positions_are_read_alike() {
        let plain = request(&[0.0, 0.0, 1.0, 0.0], &[1.0, 1.0]);
        let mut packed = plain.clone();
        packed.agents =
            Some(v1::Positions { array: Some(arrays::from_f32(&[2, 2], &[0.0, 0.0, 1.0, 0.0])), ..Default::default() });
        assert_eq!(read(plain, 1).unwrap(), read(packed, 1).unwrap());
    }

    #[test]
    fn a_team_with_goals_to_spare_or_to_lack_is_answered() {
        let more_agents = read(request(&[0.0, 0.0, 5.0, 0.0, 1.0, 0.0], &[1.0, 0.5, 0.0, 0.5]), 1).unwrap();
        let reply = ask_classical(&more_agents, SchedulerKind::Exact).unwrap();
        let response = write(&more_agents, &reply).unwrap();
        assert_eq!((response.unassigned_agents, response.unassigned_goals), (vec![1], vec![]));
        assert!((response.cost - 1.0).abs() < 1e-9 && response.gap == 0.0);

        let more_goals = read(request(&[0.0, 0.0], &[9.0, 0.0, 2.0, 0.0]), 1).unwrap();
        for kind in [SchedulerKind::Exact, SchedulerKind::Greedy] {
            let response = write(&more_goals, &ask_classical(&more_goals, kind).unwrap()).unwrap();
            assert_eq!((response.pairs[0].goal_index, response.unassigned_goals), (1, vec![0]));
        }
    }

    #[test]
    fn wrong_fields_are_named() {
        let check = |change: fn(&mut v1::AssignRequest), words: &str| {
            let mut message = request(&[0.0, 0.0], &[1.0, 1.0]);
            change(&mut message);
            let error = read(message, 1).unwrap_err().to_string();
            assert!(error.starts_with(words), "{error}");
        };
        check(|m| m.agents = None, "agents: missing");
        check(|m| m.goals = positions(2, &[1.0]), "goals.coordinates: 1 numbers");
        check(|m| m.goals = positions(4, &[1.0; 4]), "goals.dims: 4");
        check(|m| m.goals = positions(3, &[1.0; 3]), "goals: 3 dimensions, the agents have 2");
        check(|m| m.agents = positions(2, &[1.0, f32::NAN]), "agents.coordinates[1]: NaN");
        check(|m| m.agent_ids = vec!["a".into(), "b".into()], "agent_ids: 2 names for 1");
    }

    #[test]
    fn a_model_that_gives_a_goal_twice_is_found_out() {
        let team = read(request(&[0.0, 0.0, 1.0, 0.0], &[1.0, 0.5, 0.0, 0.5]), 1).unwrap();
        let reply = |goals: &[Option<u32>]| TeamReply { goals: goals.to_vec(), probabilities: None };
        for wrong in [vec![Some(0), Some(0)], vec![Some(0), None], vec![Some(0), Some(2)], vec![Some(0)]] {
            assert!(check(&reply(&wrong), &team.request).is_err(), "{wrong:?}");
        }
        check(&reply(&[Some(1), Some(0)]), &team.request).unwrap();
    }
}
