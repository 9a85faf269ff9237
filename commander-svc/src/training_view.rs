//! The assignments of recent training episodes, as read-only missions.

use crate::scheduler::{AssignmentMethod, GoalReply, GoalRequest, WeightsKey};
use magex_assign::pairs;
use magex_core::ids::ShardKind;
use magex_dispatch::clock::Now;
use magex_dispatch::engine::Plan;
use magex_dispatch::mission::TRAINING_PREFIX;
use magex_dispatch::{Problem, answer};
use magex_proto::v1;
use magex_runtime::sync::lock;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

/// Maximum number of shards, and of numbers in them.
const SHARDS: usize = 256;
const NUMBERS: usize = 4 << 20;
/// Numbers that the name of a mission counts as: every page sorts all names.
const NAME: usize = 64;
/// How long an episode is shown, milliseconds.
const LIVE_MS: i64 = 600_000;

/// The episodes of a shard and their assignments.
#[derive(Debug)]
pub(crate) struct TrainingShard {
    pub(crate) request: Arc<GoalRequest>,
    pub(crate) reply: GoalReply,
    pub(crate) key: WeightsKey,
    /// The method of the run's scheduler.
    pub(crate) method: AssignmentMethod,
    /// When it was answered.
    pub(crate) at: Now,
}

impl TrainingShard {
    /// Number of missions: one per stage of every episode.
    pub(crate) fn missions(&self) -> usize {
        self.request.shard.episodes as usize * self.request.stages
    }

    /// Every stage of every episode as a mission.
    pub(crate) fn assignments(&self) -> impl Iterator<Item = v1::Assignment> + '_ {
        (0..self.missions()).filter_map(|place| self.assignment(place))
    }

    /// Names of the missions, in order.
    fn names(&self) -> impl Iterator<Item = String> + '_ {
        (0..self.missions()).map(|place| {
            let (part, episode) = self.part_and_episode(place);
            format!("{TRAINING_PREFIX}{}.{part}.{episode}", self.key.run_id)
        })
    }

    fn part_and_episode(&self, place: usize) -> (String, u32) {
        let (shard, stages) = (&self.request.shard, self.request.stages);
        let mut part = match shard.kind {
            ShardKind::Train => format!("train-{}", shard.iteration),
            ShardKind::Eval => format!("eval-{}", shard.eval_set),
        };
        if stages > 1 {
            part += &format!("-stage-{}", place % stages);
        }
        (part, shard.first_episode + (place / stages.max(1)) as u32)
    }

    /// One stage of one episode; `None` if its arrays are inconsistent.
    pub(crate) fn assignment(&self, place: usize) -> Option<v1::Assignment> {
        let (request, reply) = (&*self.request, &self.reply);
        let (n, g, d) = (request.agent_count, request.goal_count, request.dims);
        let points = |values: &[f32], count: usize| -> Option<Vec<f64>> {
            let own = values.get(place * count * d..(place + 1) * count * d)?;
            Some(own.iter().copied().map(f64::from).collect())
        };
        let named = |side: &str, count: usize| (0..count).map(|k| format!("{side}-{k}")).collect();
        let problem = Problem {
            agent_ids: named("agent", n),
            goal_ids: named("goal", g),
            ..Problem::of_points(points(&request.agents, n)?, points(&request.goals, g)?, d)
        };
        let goal_of = reply.goals.get(place * n..(place + 1) * n)?.to_vec();
        if pairs(&goal_of).any(|(_, goal)| goal >= g) {
            return None;
        }
        let plan = Plan {
            pairs: problem.pair_terms(&goal_of),
            goal_of,
            scheduler: self.method,
            cost: f64::from(*reply.costs.get(place)?),
            exact_cost: Some(f64::from(*reply.exact_costs.get(place)?)),
            ..Plan::default()
        };
        let answer = answer::write(&problem, &plan);
        let members = |ids: Vec<String>, positions: &[f64]| {
            let state = v1::MemberState::Active.into();
            let member = |(id, position): (String, &[f64])| v1::Member {
                id,
                position: position.to_vec(),
                state,
                ..Default::default()
            };
            ids.into_iter().zip(positions.chunks_exact(d.max(1))).map(member).collect()
        };
        let (part, episode) = self.part_and_episode(place);
        let run_id = self.key.run_id.0.clone();
        Some(v1::Assignment {
            mission_id: format!("{TRAINING_PREFIX}{run_id}.{part}.{episode}"),
            title: format!("{part} episode {episode} of run {run_id}"),
            source: v1::MissionSource::Training.into(),
            revision: 1,
            power: 1.0,
            agents: members(problem.agent_ids, &problem.agents),
            goals: members(problem.goal_ids, &problem.goals),
            pairs: answer.pairs,
            agents_without_goal: answer.agents_without_goal,
            goals_without_agent: answer.goals_without_agent,
            largest_cost: answer.largest_cost,
            cost: answer.cost,
            exact_cost: answer.exact_cost,
            gap: answer.gap,
            scheduler: answer.scheduler,
            answered_by: answer.scheduler,
            version: self.key.version.0,
            sha256: self.key.sha256.clone(),
            run_id,
            created_ms: self.at.day_ms,
            updated_ms: self.at.day_ms,
            expires_ms: self.at.day_ms + LIVE_MS,
            ..Default::default()
        })
    }

    fn numbers(&self) -> usize {
        let named = NAME * self.missions();
        named + self.request.agents.len() + self.request.goals.len() + self.reply.goals.len()
    }
}

/// One stage of one episode: its name, its shard, and its place there.
pub(crate) type Episode = (String, Arc<TrainingShard>, usize);

/// The latest shards.
#[derive(Debug, Default)]
pub(crate) struct TrainingView {
    shards: Mutex<VecDeque<Arc<TrainingShard>>>,
}

impl TrainingView {
    /// Adds a shard; the oldest are dropped at the limits.
    pub(crate) fn insert(&self, shard: Arc<TrainingShard>) {
        let mut shards = lock(&self.shards);
        // A repeated request of an actor gets the same answer: it is the same mission.
        shards.retain(|old| old.request.shard != shard.request.shard || old.key.run_id != shard.key.run_id);
        shards.push_back(shard);
        let mut numbers: usize = shards.iter().map(|shard| shard.numbers()).sum();
        while shards.len() > SHARDS || (numbers > NUMBERS && shards.len() > 1) {
            numbers -= shards.pop_front().map_or(0, |shard| shard.numbers());
        }
    }

    /// Shards that are still live, oldest first.
    pub(crate) fn live(&self, now: &Now) -> Vec<Arc<TrainingShard>> {
        let mut shards = lock(&self.shards);
        shards.retain(|shard| shard.at.clock_ms + LIVE_MS > now.clock_ms);
        shards.iter().cloned().collect()
    }

    /// The episode of this name.
    pub(crate) fn get(&self, id: &str, now: &Now) -> Option<v1::Assignment> {
        self.live(now).iter().find_map(|shard| {
            let b = shard.names().position(|name| name == id)?;
            shard.assignment(b)
        })
    }

    /// Up to `count` episodes after this name, by name.
    pub(crate) fn page(&self, after: &str, count: usize, now: &Now) -> Vec<Episode> {
        let shards = self.live(now);
        let mut names: Vec<(String, usize, usize)> = shards
            .iter()
            .enumerate()
            .flat_map(|(k, shard)| shard.names().enumerate().map(move |(b, name)| (name, k, b)))
            .filter(|(name, ..)| name.as_str() > after)
            .collect();
        names.sort_unstable();
        names.dedup_by(|a, b| a.0 == b.0);
        names.truncate(count);
        names.into_iter().map(|(name, k, place)| (name, shards[k].clone(), place)).collect()
    }
}
