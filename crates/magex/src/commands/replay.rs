//! `magex replay`

use crate::artifacts::{describe, write_replay};
use crate::evaluate::{self, Controller, EVAL_SET, Episodes, Modes, Variation, mode_name, roll_out};
use crate::folder;
use crate::options::CommonOptions;
use magex_core::ids::Mode;
use magex_runtime::exit;
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

Exit codes: 0 success, 1 rollout failed, 64 wrong usage or configuration,
73 the file cannot be written";

/// Record evaluation episodes as an HTML page.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct ReplayArgs {
    /// Run folder, or a weights file together with --config.
    #[arg(value_name = "RUN")]
    pub(crate) run: PathBuf,
    /// Configuration of a weights file.
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// The page [default: replay.html in the run folder].
    #[arg(long, short, value_name = "FILE.html")]
    pub(crate) out: Option<PathBuf>,
    /// Episodes on the page.
    #[arg(long, value_name = "K", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(crate) episodes: u32,
    /// How actions and goals are chosen.
    #[arg(long, value_enum, value_name = "MODE", default_value = "greedy")]
    pub(crate) mode: Modes,
    /// Evaluation set: selects the starts; 3 or more.
    #[arg(long, value_name = "SET", default_value_t = EVAL_SET, value_parser = evaluate::eval_set)]
    pub(crate) eval_set: u32,
    #[command(flatten)]
    pub(crate) vary: Variation,
}

pub(crate) fn run(args: &ReplayArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let output = options.output();
    let trained = folder::load(&args.run, args.config.as_deref())?;
    trained.notes.iter().for_each(|text| tracing::warn!("{text}"));
    let config = args.vary.apply(&trained)?;
    let policy = args.vary.policy(&config, &trained.weights)?;
    let mut episodes = Vec::new();
    for &mode in args.mode.list() {
        let wanted = Episodes { count: args.episodes, set: args.eval_set, mode, record: args.episodes };
        let (metrics, recordings) = roll_out(&policy, &config, wanted, processors())?;
        episodes.extend(recordings.into_iter().zip(metrics.into_iter().map(Some)));
    }
    let modes: Vec<&str> = args.mode.list().iter().map(|&mode: &Mode| mode_name(mode)).collect();
    let driver = match args.vary.controller {
        Controller::Learned => String::new(),
        Controller::Scripted => " · scripted controller".to_owned(),
    };
    let scheduler = args.vary.scheduler.map(|kind| format!(" · goals from {kind}")).unwrap_or_default();
    let subtitle = format!("{} · {}{driver}{scheduler}", describe(&config), modes.join(" and "));
    let folder = trained.folder.clone().unwrap_or_default();
    let path = args.out.clone().unwrap_or_else(|| folder.join("replay.html"));
    write_replay(&path, &trained.name, &subtitle, &config, &episodes)?;
    output.say(format!("{} ({} episodes): open it in a browser", path.display(), episodes.len()));
    output.result(&json!({ "out": path, "episodes": episodes.len(), "weights_sha256": trained.sha256 }));
    Ok(exit::OK)
}
