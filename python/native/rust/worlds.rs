//! W worlds of one task, over a few threads.

use crate::options::Options;
use crate::shard::{Begin, Plan, Shard, by_metric};
use magex_core::error::{FieldError, check_count};
use rayon::ThreadPool;
use rayon::prelude::*;

/// Worlds of a particle task that share vector registers.
const LANES: usize = 16;
/// Worlds of a shard at most: what a step reads and writes of them stays in the second-level cache.
const SHARD_MOST: usize = 64;
/// Limit of the worlds, and of the numbers of all observations.
pub(crate) const WORLDS_MAX: usize = 1 << 20;

/// The worlds. Neither the number of threads nor that of the worlds changes a number of a world.
pub(crate) struct Worlds {
    pub(crate) plan: Plan,
    shards: Vec<Shard>,
    /// Seed of world 0; nothing before the first reset.
    seed: Option<u64>,
    /// Number of the present episode since the seed was given.
    episode: u32,
    /// Joint steps of the present episode.
    pub(crate) steps: u32,
    threads: usize,
    pool: Option<Pool>,
}

/// Threads, and the process that they are of: a fork leaves them behind.
struct Pool {
    threads: ThreadPool,
    process: u32,
}

/// The arrays that a step overwrites.
pub(crate) struct Outputs<'a> {
    /// [W, N]
    pub(crate) rewards: &'a mut [f32],
    /// [W, N, V] of the state after the step, or of the next episode's start; what is empty or absent is not computed.
    pub(crate) observations: Option<&'a mut [f32]>,
    /// [W, N, V] of the last state of the episodes that end with this step; written only if they do.
    pub(crate) last: Option<&'a mut [f32]>,
}

/// What happened in a step.
pub(crate) struct Stepped {
    pub(crate) ended: bool,
    /// Of the episodes, if they ended.
    pub(crate) metrics: Vec<(&'static str, Vec<f32>)>,
}

/// A shard with its part of the arrays; empty where an array is not wanted.
struct Job<'a> {
    shard: &'a mut Shard,
    actions: &'a [u8],
    rewards: &'a mut [f32],
    observations: &'a mut [f32],
    last: &'a mut [f32],
}

impl Worlds {
    pub(crate) fn new(options: Options, count: usize, threads: usize) -> Result<Self, FieldError> {
        let shape = options.task.shape(1);
        let numbers = count.saturating_mul(shape.agents).saturating_mul(options.observer.width());
        if count == 0 || count > WORLDS_MAX || numbers > 1 << 34 {
            let problem = format!("{count} is out of range; use 1 to {WORLDS_MAX}, and fewer for large teams");
            return Err(FieldError::new("worlds", problem));
        }
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = if threads == 0 { cores } else { threads.min(256) };
        let assigns = options.needs_goals();
        let plan = Plan { worlds: count, shape, assigns, observer: options.observer, task: options.task };
        Ok(Self { plan, shards: Vec::new(), seed: None, episode: 0, steps: 0, threads, pool: None })
    }

    /// V.
    pub(crate) fn width(&self) -> usize {
        self.plan.observer.width()
    }

    /// [W, N, V]
    fn numbers(&self) -> usize {
        self.plan.worlds * self.plan.shape.agents * self.width()
    }

    /// Begins an episode in every world: the first one of a seed, or the next one of the last seed; world w has the seed + w. Or
    /// it begins where positions and velocities [W, E, D] and landmarks [W, N, D] say; the seed is that of the next ones then.
    pub(crate) fn reset(&mut self, seed: Option<u64>, given: Option<[&[f32]; 3]>) -> Result<(), FieldError> {
        let (seed, episode) = match (seed, self.seed) {
            (Some(seed), _) => (seed, 0),
            (None, Some(seed)) => (seed, next(self.episode)?),
            (None, None) => return Err(FieldError::new("seed", "missing; the first reset needs one")),
        };
        if seed.checked_add(self.plan.worlds as u64).is_none() {
            return Err(FieldError::new("seed", format!("{seed} is too large; seed + worlds must be below 2^64")));
        }
        let (ranges, plan) = (self.ranges(), &self.plan);
        let begin = given.map_or(Begin::Drawn { seed, episode }, Begin::Given);
        let make = |worlds| Shard::new(plan, worlds, begin);
        let made: Result<Vec<Shard>, FieldError> = match pool(&mut self.pool, self.threads, ranges.len())? {
            Some(pool) => pool.install(|| ranges.into_par_iter().map(make).collect()),
            None => ranges.into_iter().map(make).collect(),
        };
        (self.shards, self.seed, self.episode, self.steps) = (made?, Some(seed), episode, 0);
        Ok(())
    }

    /// Takes goals [W, N, K].
    pub(crate) fn set_goals(&mut self, goals: &[u32]) -> Result<(), FieldError> {
        self.begun()?;
        let each = self.plan.shape.agents * self.plan.shape.goals_per_agent;
        check_count("goals", "entries", goals.len(), self.plan.worlds * each)?;
        // All or none of the shards take them.
        let members = self.plan.shape.agents as u32;
        if let Some(place) = goals.iter().position(|&goal| goal >= members) {
            let problem = format!("{} is not a goal; use an index below {members}", goals[place]);
            return Err(FieldError::new(format!("goals[{}][{}]", place / each, place % each), problem));
        }
        for shard in &mut self.shards {
            let worlds = shard.worlds.clone();
            shard.set_goals(&goals[worlds.start * each..worlds.end * each])?;
        }
        Ok(())
    }

    /// Writes the observations [W, N, V] of the present state.
    pub(crate) fn observe(&mut self, out: &mut [f32]) -> Result<(), FieldError> {
        self.begun()?;
        check_count("observations", "entries", out.len(), self.numbers())?;
        let outputs = Outputs { rewards: &mut [], observations: Some(out), last: None };
        self.run(&[], outputs, |plan, job| job.shard.observe(plan, job.observations))
    }

    /// One joint step of every world. `actions` [W, N, H] are checked already. With the last step of the episodes the next ones
    /// begin if `restarts`.
    pub(crate) fn step(&mut self, actions: &[u8], outputs: Outputs<'_>, restarts: bool) -> Result<Stepped, FieldError> {
        self.begun()?;
        let rows = self.plan.worlds * self.plan.shape.agents;
        check_count("actions", "entries", actions.len(), rows * self.plan.shape.action_components)?;
        check_count("rewards", "entries", outputs.rewards.len(), rows)?;
        for out in [&outputs.observations, &outputs.last].into_iter().flatten() {
            check_count("observations", "entries", out.len(), self.numbers())?;
        }
        if self.steps >= self.plan.task.horizon {
            return Err(FieldError::new("step", "the episodes are over; call reset first"));
        }
        let ended = self.steps + 1 == self.plan.task.horizon;
        let seed = self.seed.unwrap_or_default();
        let episode = if ended && restarts { next(self.episode)? } else { self.episode };
        self.run(actions, outputs, |plan, job| {
            let Job { shard, actions, rewards, observations, last } = job;
            shard.env.step(actions, rewards)?;
            if ended {
                shard.finish();
                if !last.is_empty() {
                    shard.observe(plan, last)?;
                }
                if restarts {
                    shard.restart(plan, Begin::Drawn { seed, episode })?;
                }
            }
            if observations.is_empty() { Ok(()) } else { shard.observe(plan, observations) }
        })?;
        if !ended {
            self.steps += 1;
            return Ok(Stepped { ended, metrics: Vec::new() });
        }
        (self.steps, self.episode) = (if restarts { 0 } else { self.steps + 1 }, episode);
        let scores: Vec<_> = self.shards.iter().flat_map(|shard| shard.scores.iter().copied()).collect();
        Ok(Stepped { ended, metrics: by_metric(&scores) })
    }

    /// Does some work on every shard with its part of the arrays.
    fn run(
        &mut self,
        actions: &[u8],
        outputs: Outputs<'_>,
        work: impl Fn(&Plan, Job<'_>) -> Result<(), FieldError> + Sync,
    ) -> Result<(), FieldError> {
        let (s, width) = (self.plan.shape, self.width());
        let Outputs { mut rewards, observations, last } = outputs;
        let (mut observations, mut last) = (observations.unwrap_or_default(), last.unwrap_or_default());
        let mut actions = actions;
        let pool = pool(&mut self.pool, self.threads, self.shards.len())?;
        let jobs = self.shards.iter_mut().map(|shard| {
            let rows = shard.worlds.len() * s.agents;
            let (acts, rest) = actions.split_at_checked(rows * s.action_components).unwrap_or_default();
            actions = rest;
            Job {
                shard,
                actions: acts,
                rewards: part(&mut rewards, rows),
                observations: part(&mut observations, rows * width),
                last: part(&mut last, rows * width),
            }
        });
        let plan = &self.plan;
        match pool {
            Some(pool) => {
                let jobs: Vec<Job<'_>> = jobs.collect();
                pool.install(|| jobs.into_par_iter().try_for_each(|job| work(plan, job)))
            }
            None => {
                let mut jobs = jobs;
                jobs.try_for_each(|job| work(plan, job))
            }
        }
    }

    /// [W, E, D] positions and velocities, [W, N, X] further state, [W, G, D] landmarks, [W, N, K] goals.
    pub(crate) fn state(&mut self) -> Result<([Vec<f32>; 4], Vec<u32>), FieldError> {
        self.begun()?;
        let (mut arrays, mut goals) = ([const { Vec::new() }; 4], Vec::new());
        for shard in &mut self.shards {
            shard.look(&self.plan)?;
            let [positions, velocities, agent_state, landmarks] = &mut arrays;
            positions.extend_from_slice(&shard.state.positions);
            velocities.extend_from_slice(&shard.state.velocities);
            agent_state.extend_from_slice(&shard.state.agent_state);
            landmarks.extend_from_slice(shard.env.statics().get(magex_core::statics::LANDMARKS));
            goals.extend_from_slice(&shard.goals);
        }
        Ok((arrays, goals))
    }

    fn begun(&self) -> Result<(), FieldError> {
        if self.shards.is_empty() { Err(FieldError::new("reset", "missing; call reset first")) } else { Ok(()) }
    }

    /// Worlds in shards: whole registers where worlds share them, and a few shards for every thread.
    fn ranges(&self) -> Vec<std::ops::Range<usize>> {
        let lanes = if self.plan.shape.dims == 2 { LANES } else { 1 };
        let groups = self.plan.worlds.div_ceil(lanes);
        let of_shard = lanes * groups.div_ceil(4 * self.threads).clamp(1, SHARD_MOST / lanes);
        (0..self.plan.worlds).step_by(of_shard).map(|from| from..(from + of_shard).min(self.plan.worlds)).collect()
    }
}

/// Takes the next part of an array; an array that is not wanted has empty ones.
fn part<'a>(array: &mut &'a mut [f32], count: usize) -> &'a mut [f32] {
    let (own, rest) = std::mem::take(array).split_at_mut_checked(count).unwrap_or_default();
    *array = rest;
    own
}

fn next(episode: u32) -> Result<u32, FieldError> {
    episode.checked_add(1).ok_or_else(|| FieldError::new("seed", "has no further episode; reset with another seed"))
}

/// The threads, if there is work for more than one. A process that was forked makes its own.
fn pool(pool: &mut Option<Pool>, threads: usize, shards: usize) -> Result<Option<&ThreadPool>, FieldError> {
    if threads < 2 || shards < 2 {
        return Ok(None);
    }
    let process = std::process::id();
    if pool.as_ref().is_none_or(|pool| pool.process != process) {
        let built = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|k| format!("magex-{k}")).build();
        let threads = built.map_err(|error| FieldError::new("threads", format!("{error}; use 1")))?;
        *pool = Some(Pool { threads, process });
    }
    Ok(pool.as_ref().map(|pool| &pool.threads))
}
