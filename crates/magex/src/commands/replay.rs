//! `magex replay`

use crate::artifacts::{self, describe, write_replay};
use crate::evaluate::{Controller, Episodes, Modes, Subject, mode_name, roll_out};
use crate::options::CommonOptions;
use crate::output::note;
use magex_runtime::exit;
use magex_runtime::options;
use magex_runtime::process::processors;
use serde_json::json;
use std::path::PathBuf;

const AFTER_HELP: &str = "\
Examples:
  magex replay runs/simple-spread-50-magex-s1        rewrites its replay.html
  magex replay RUN --episodes 8 --spawn uniform --out wild.html
  magex replay RUN --agents 200 --scheduler exact --out big.html
  magex replay RUN --controller scripted --out baseline.html

The page is one self-contained file: open it in any browser.

Exit codes: 0 success, 1 rollout failed, 64 wrong usage or configuration, \
    73 the file cannot be written";

/// Record evaluation episodes as an HTML page.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct ReplayArgs {
    /// The page [default: replay.html in the run folder].
    #[arg(long, short, value_name = "FILE.html")]
    out: Option<PathBuf>,
    /// Episodes on the page.
    #[arg(long, value_name = "K", default_value_t = 4, value_parser = options::whole::<u32>(1, 100))]
    episodes: u32,
    /// How actions and goals are chosen.
    #[arg(long, value_enum, value_name = "MODE", default_value = "greedy")]
    mode: Modes,
    #[command(flatten)]
    subject: Subject,
}

pub(crate) fn run(args: &ReplayArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let output = options.output();
    args.out.as_deref().map_or(Ok(()), artifacts::check)?;
    let (trained, config) = args.subject.load()?;
    let vary = &args.subject.vary;
    let (policy, _) = args.subject.policy(&config, &trained.weights)?;
    note(format!("{} · N = {} · recording {} episodes", trained.name, config.task.agents, args.episodes));
    let mut episodes = Vec::new();
    for &mode in args.mode.list() {
        let wanted = Episodes { count: args.episodes, set: args.subject.eval_set, mode, record: args.episodes };
        let (metrics, recordings) = roll_out(&policy, &config, wanted, processors())?;
        episodes.extend(recordings.into_iter().zip(metrics.into_iter().map(Some)));
    }
    let modes: Vec<&str> = args.mode.list().iter().copied().map(mode_name).collect();
    let driver = match vary.controller {
        Controller::Learned => String::new(),
        controller => format!(" · {controller} controller"),
    };
    let scheduler = vary.scheduler.map(|kind| format!(" · goals from {kind}")).unwrap_or_default();
    let subtitle = format!("{} · {}{driver}{scheduler}", describe(&config), modes.join(" and "));
    let folder = trained.folder.clone().unwrap_or_default();
    let path = args.out.clone().unwrap_or_else(|| folder.join("replay.html"));
    write_replay(&path, &trained.name, &subtitle, &config, &episodes)?;
    output.say(format!("{} ({} episodes): open it in a browser", path.display(), episodes.len()));
    output.result(&json!({ "out": path, "episodes": episodes.len(), "weights_sha256": trained.sha256 }));
    Ok(exit::OK)
}
