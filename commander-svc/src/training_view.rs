//! The assignments of recent training episodes, as read-only missions.

use crate::scheduler::{AssignmentMethod, GoalReply, GoalRequest, WeightsKey};
use magex_core::ids::ShardKind;
use magex_dispatch::view;
use magex_proto::v1;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

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
    pub(crate) reply: Arc<GoalReply>,
    pub(crate) key: WeightsKey,
    /// The method of the run's scheduler.
    pub(crate) method: AssignmentMethod,
    /// When it was answered, milliseconds since 1970.
    pub(crate) at_ms: i64,
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
        let prefix = format!("{}{}", magex_dispatch::mission::TRAINING_PREFIX, self.key.run_id);
        (0..self.missions()).map(move |place| {
            let (part, episode) = (self.part(place % self.request.stages), place / self.request.stages);
            format!("{prefix}.{part}.{}", self.request.shard.first_episode + episode as u32)
        })
    }

    fn part(&self, stage: usize) -> String {
        let part = match self.request.shard.kind {
            ShardKind::Train => format!("train-{}", self.request.shard.iteration),
            ShardKind::Eval => format!("eval-{}", self.request.shard.eval_set),
        };
        if self.request.stages > 1 { format!("{part}-stage-{stage}") } else { part }
    }

    fn assignment(&self, place: usize) -> Option<v1::Assignment> {
        let (request, reply) = (&*self.request, &*self.reply);
        let (n, g, d) = (request.agent_count, request.goal_count, request.dims);
        let part = self.part(place % request.stages.max(1));
        let episode = view::Episode {
            run_id: &self.key.run_id.0,
            part: &part,
            index: request.shard.first_episode + (place / request.stages.max(1)) as u32,
            dims: d,
            agents: request.agents.get(place * n * d..(place + 1) * n * d)?,
            goals: request.goals.get(place * g * d..(place + 1) * g * d)?,
            goal_of: reply.goals.get(place * n..(place + 1) * n)?,
            scheduler: self.method,
            version: self.key.version.0,
            sha256: &self.key.sha256,
            cost: f64::from(*reply.costs.get(place)?),
            exact_cost: f64::from(*reply.exact_costs.get(place)?),
            at_ms: self.at_ms,
            expires_ms: self.at_ms + LIVE_MS,
        };
        Some(episode.assignment())
    }

    fn numbers(&self) -> usize {
        let named = NAME * self.missions();
        named + self.request.agents.len() + self.request.goals.len() + self.reply.goals.len()
    }
}

/// One stage of one episode of a shard.
#[derive(Debug)]
pub(crate) struct Episode {
    pub(crate) name: String,
    shard: Arc<TrainingShard>,
    place: usize,
}

impl Episode {
    /// As a mission.
    pub(crate) fn assignment(&self) -> Option<v1::Assignment> {
        self.shard.assignment(self.place)
    }
}

/// The latest shards.
#[derive(Debug, Default)]
pub(crate) struct TrainingView {
    shards: Mutex<VecDeque<Arc<TrainingShard>>>,
}

impl TrainingView {
    /// Adds a shard; the oldest are dropped at the limits.
    pub(crate) fn insert(&self, shard: Arc<TrainingShard>) {
        let mut shards = self.lock();
        // A repeated request of an actor gets the same answer: it is the same mission.
        shards.retain(|old| old.request.shard != shard.request.shard || old.key.run_id != shard.key.run_id);
        shards.push_back(shard);
        let mut numbers: usize = shards.iter().map(|shard| shard.numbers()).sum();
        while shards.len() > SHARDS || (numbers > NUMBERS && shards.len() > 1) {
            numbers -= shards.pop_front().map_or(0, |shard| shard.numbers());
        }
    }

    /// Shards that are still live at `now` (milliseconds since 1970), oldest first.
    pub(crate) fn live(&self, now: i64) -> Vec<Arc<TrainingShard>> {
        let mut shards = self.lock();
        shards.retain(|shard| shard.at_ms + LIVE_MS > now);
        shards.iter().cloned().collect()
    }

    /// The episode of this name.
    pub(crate) fn get(&self, id: &str, now: i64) -> Option<v1::Assignment> {
        self.live(now).iter().find_map(|shard| {
            let b = shard.names().position(|name| name == id)?;
            shard.assignment(b)
        })
    }

    /// Up to `count` episodes after this name, by name.
    pub(crate) fn page(&self, after: &str, count: usize, now: i64) -> Vec<Episode> {
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
        names.into_iter().map(|(name, k, place)| Episode { name, shard: shards[k].clone(), place }).collect()
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Arc<TrainingShard>>> {
        self.shards.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
