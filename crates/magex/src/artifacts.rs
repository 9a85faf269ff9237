//! The pictures of a run folder: `curve.svg` and `replay.html`.

use crate::failure::cannot_create;
use anyhow::Context as _;
use magex_core::config::RunConfig;
use magex_core::task::TaskName;
use magex_core::trajectory::{EpisodeMetrics, Recording};
use magex_runtime::limits;
use magex_viewer::curve::{curve_svg, parse_metrics};
use magex_viewer::pictures::pictures_html;
use magex_viewer::replay::replay_html;
use rustix::fs::{Access, access};
use std::path::Path;

/// Task, executor, scheduler and seed of a run on one line.
pub(crate) fn describe(config: &RunConfig) -> String {
    let (task, commander) = (&config.task, config.commander.kind);
    if let Ok(external) = task.external() {
        let (name, agents, executor, seed) =
            (&external.environment, task.agents, config.executor.kind, config.run.seed);
        return format!("{name}, N = {agents} · executor {executor} · seed {seed}");
    }
    format!(
        "{}, N = {}, {} · executor {} · scheduler {commander} · seed {}",
        task.definition().title,
        task.agents,
        task.spawn,
        config.executor.kind,
        config.run.seed
    )
}

/// Draws `curve.svg` from `metrics.jsonl`.
pub(crate) fn write_curve(folder: &Path, config: &RunConfig) -> anyhow::Result<()> {
    let metrics = folder.join("metrics.jsonl");
    let text = std::fs::read_to_string(&metrics).with_context(|| metrics.display().to_string())?;
    let svg = curve_svg(&run_name(folder), &describe(config), &parse_metrics(&text)?)?;
    write(&folder.join("curve.svg"), svg.as_bytes())
}

pub(crate) fn write_replay(
    path: &Path,
    title: &str,
    subtitle: &str,
    config: &RunConfig,
    episodes: &[(Recording, Option<EpisodeMetrics>)],
) -> anyhow::Result<()> {
    let page = match config.task.name {
        TaskName::External => pictures_html(title, subtitle, episodes)?,
        _ => replay_html(&config.task, title, subtitle, episodes)?,
    };
    write(path, page.as_bytes())
}

/// Writes `replay.html` from the recordings in the run folder; an external environment that draws nothing has none.
pub(crate) fn write_recorded_replay(folder: &Path, config: &RunConfig) -> anyhow::Result<()> {
    if config.task.external().is_ok_and(|external| !external.renders) {
        return Ok(());
    }
    let source = folder.join("recordings.json");
    let bytes = std::fs::read(&source).with_context(|| source.display().to_string())?;
    let recordings: Vec<Recording> = serde_json::from_slice(&bytes).with_context(|| source.display().to_string())?;
    let episodes: Vec<_> = recordings.into_iter().map(|recording| (recording, None)).collect();
    let subtitle = format!("{} · greedy evaluation at the end of training", describe(config));
    write_replay(&folder.join("replay.html"), &run_name(folder), &subtitle, config, &episodes)
}

pub(crate) fn run_name(folder: &Path) -> String {
    folder.file_name().map_or_else(|| "run".into(), |name| name.to_string_lossy().into_owned())
}

/// Fails where [`write()`] would: before the work whose result it is to write. The folders that are missing can be made where the
/// part of the path that exists is a folder that can be written.
pub(crate) fn check(path: &Path) -> anyhow::Result<()> {
    let refused = |part: &Path, why: &str| {
        let part = if part.as_os_str().is_empty() { Path::new(".") } else { part };
        Err(cannot_create(format!("{}: {} {why}", path.display(), part.display())))
    };
    if path.is_dir() {
        return refused(path, "is a folder; name a file in it");
    }
    let Some(there) = path.ancestors().skip(1).find(|part| part.as_os_str().is_empty() || part.exists()) else {
        return Ok(());
    };
    let folder = if there.as_os_str().is_empty() { Path::new(".") } else { there };
    match access(folder, Access::WRITE_OK | Access::EXEC_OK) {
        _ if !folder.is_dir() => refused(there, "is not a folder"),
        Err(error) => refused(there, &format!("cannot be written ({})", std::io::Error::from(error))),
        Ok(()) => Ok(()),
    }
}

/// Writes a file atomically: to a temporary file that is then renamed. Makes the folders above it.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".tmp");
    path.parent()
        .map_or(Ok(()), std::fs::create_dir_all)
        .and_then(|()| std::fs::write(&temporary, bytes))
        .and_then(|()| std::fs::rename(&temporary, path))
        .map_err(limits::explained)
        .inspect_err(|_| drop(std::fs::remove_file(&temporary)))
        .map_err(|error| cannot_create(format!("{}: {error}", path.display())))
}

/// Rows as CSV, quoted where it is needed.
pub(crate) fn csv(rows: &[Vec<String>]) -> String {
    let cell = |cell: &String| match cell.contains([',', '"', '\n']) {
        true => format!("\"{}\"", cell.replace('"', "\"\"")),
        false => cell.clone(),
    };
    rows.iter().map(|row| row.iter().map(cell).collect::<Vec<_>>().join(",") + "\n").collect()
}
