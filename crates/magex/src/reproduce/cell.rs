//! One cell and seed: trained if it must be, then evaluated.

use super::budget::Cell;
use super::record::{EndedBy, Evaluated, FORMAT, Record, curve_of};
use super::systems::By;
use crate::evaluate::{EVAL_SET, Episodes, Variation, roll_out};
use crate::failure::usage;
use crate::folder;
use crate::progress::Progress;
use crate::runs::SeedRun;
use crate::settings;
use crate::supervise::TrainEnd;
use crate::training::{Means, Plan};
use magex_core::config::RunConfig;
use magex_core::ids::Mode;
use magex_learner::run_folder::RunFolderState;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

/// The name of this process in the lock of a run folder.
const COMMAND: &str = "magex reproduce";

/// What is around a cell.
pub(crate) struct Place<'a> {
    pub(crate) out: &'a Path,
    pub(crate) threads: usize,
    pub(crate) episodes: u32,
    pub(crate) runtime: &'a Runtime,
    pub(crate) interrupted: &'a CancellationToken,
}

/// The run folder of a cell and seed.
pub(crate) fn run_folder(out: &Path, cell: &Cell, seed: u64) -> PathBuf {
    folder::of_seed(&out.join("runs").join(cell.table.name).join(cell.id()), seed)
}

/// The configuration of a cell and seed.
pub(crate) fn configuration(cell: &Cell, seed: u64) -> RunConfig {
    let mut config = cell.config.clone();
    config.run.seed = seed;
    config
}

/// Fails if the folder of a cell and seed holds a run of another configuration.
pub(crate) fn check_folder(out: &Path, cell: &Cell, seed: u64) -> anyhow::Result<()> {
    let path = run_folder(out, cell, seed);
    match RunFolderState::of(&path) {
        RunFolderState::Empty => return Ok(()),
        RunFolderState::Other => {
            return Err(usage(format!("{} is not a run folder; choose another --out", path.display())));
        }
        RunFolderState::Begun | RunFolderState::Run => {}
    }
    let own = settings::flat(&folder::config_of(&path)?)?;
    let differing = settings::changes(&own, &settings::flat(&configuration(cell, seed))?);
    if differing.is_empty() { Ok(()) } else { Err(other(&path, &differing)) }
}

/// The refusal of what was made with another configuration.
pub(crate) fn other(path: &Path, differing: &[String]) -> anyhow::Error {
    let remedy = "choose another --out, or remove it";
    usage(format!("{} has another configuration ({}); {remedy}", path.display(), differing.join(", ")))
}

/// Trains what is missing and evaluates. `None` if it was interrupted; the run continues the next time.
pub(crate) fn measure(place: &Place<'_>, cell: &Cell, seed: u64) -> anyhow::Result<Option<Record>> {
    let config = configuration(cell, seed);
    let mut record = Record {
        format: FORMAT.to_owned(),
        table: cell.table.name.to_owned(),
        system: cell.system.id.to_owned(),
        agents: cell.agents(),
        seed,
        config: settings::as_json(&config)?,
        weights_sha256: None,
        joint_env_steps: 0,
        wall_s: 0.0,
        ended_by: EndedBy::NoTraining,
        converged: None,
        eval_set: EVAL_SET,
        greedy: Evaluated::default(),
        sampled: Evaluated::default(),
        planning_ms: None,
        curve: Vec::new(),
    };
    match &cell.system.by {
        By::Controller(controller, scheduler) => {
            let (controller, scheduler) = (*controller, Some(*scheduler));
            let vary = Variation { controller, scheduler, ..Variation::default() };
            (record.greedy, record.sampled, record.planning_ms) = evaluate(place, &config, &vary, &[])?;
        }
        By::Learner { .. } => {
            let folder = run_folder(place.out, cell, seed);
            if train(place, cell, &config, &folder)? == TrainEnd::Stopped && place.interrupted.is_cancelled() {
                return Ok(None);
            }
            let trained = folder::load(&folder, None)?;
            let run = SeedRun::read(&folder)?;
            let (curve, flat) = curve_of(&run);
            record.ended_by = match &run.summary {
                Some(summary) if summary.target_reached => EndedBy::Target,
                Some(_) => EndedBy::Steps,
                None => EndedBy::Time,
            };
            record.converged = if record.ended_by == EndedBy::Target { Some(true) } else { flat };
            (record.joint_env_steps, record.wall_s, record.curve) = (run.steps(), run.wall_s(), curve);
            record.weights_sha256 = Some(trained.sha256);
            (record.greedy, record.sampled, _) = evaluate(place, &config, &Variation::default(), &trained.weights)?;
        }
    }
    Ok((!place.interrupted.is_cancelled()).then_some(record))
}

/// Trains in this process until the run is complete, its wall time is spent or the command is interrupted.
fn train(place: &Place<'_>, cell: &Cell, config: &RunConfig, folder: &Path) -> anyhow::Result<TrainEnd> {
    let spent = if RunFolderState::of(folder) == RunFolderState::Run { SeedRun::read(folder)?.wall_s() } else { 0.0 };
    let means =
        Means { threads: place.threads, http: None, actors: None, command: COMMAND, environment: Default::default() };
    let plan = Plan::prepare(config.clone(), None, Some(folder), true, means)?;
    // The wall time stops a training as Ctrl-C does: after an iteration, with a checkpoint.
    let stop = place.interrupted.child_token();
    let timer = cell.wall_s.map(|limit| {
        let (stop, left) = (stop.clone(), Duration::from_secs_f64((limit - spent).max(0.0)));
        place.runtime.spawn(async move {
            tokio::time::sleep(left).await;
            stop.cancel();
        })
    });
    let mut progress = Progress::live_line(config);
    let end = plan.train(place.runtime, &stop, &mut progress);
    if let Some(timer) = timer {
        timer.abort();
    }
    end
}

/// Greedy and sampled, and the milliseconds per episode that a controller without weights computed.
fn evaluate(
    place: &Place<'_>,
    config: &RunConfig,
    vary: &Variation,
    weights: &[u8],
) -> anyhow::Result<(Evaluated, Evaluated, Option<f64>)> {
    let (policy, planning) = vary.policy(config, weights)?;
    let of = |mode: Mode| {
        let episodes = Episodes { count: place.episodes, set: EVAL_SET, mode, record: 0 };
        anyhow::Ok(Evaluated::of(&roll_out(&policy, config, episodes, place.threads)?.0))
    };
    let (greedy, sampled) = (of(Mode::Greedy)?, of(Mode::Sampled)?);
    Ok((greedy, sampled, planning.map(|clock| clock.take_ms() / f64::from(2 * place.episodes))))
}
