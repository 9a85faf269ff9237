//! `soak`: memory and open files of every process of a training cluster, over a long time.

use crate::fleet::Fleet;
use crate::report::Report;
use crate::runs::Keep;
use crate::vitals::{memory_mib, open_files};
use magex::output::note;
use magex::settings;
use magex_proto::v1;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_runtime::client;
use serde_json::json;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Options of `soak`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct SoakArgs {
    /// Minutes that are measured.
    #[arg(long, value_name = "M", default_value_t = 60, value_parser = settings::count)]
    minutes: u32,
    /// Minutes before that, in which caches and histories fill.
    #[arg(long, value_name = "M", default_value_t = 10, value_parser = settings::count)]
    warm_up: u32,
    /// Seconds from one sample to the next.
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = settings::count)]
    every: u32,
    /// Configuration of the run, which never reaches its end [default: Simple Spread with 50 agents].
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Actor processes.
    #[arg(long, value_name = "N", default_value_t = 2)]
    actors: usize,
    #[command(flatten)]
    keep: Keep,
}

/// One sample of a process.
#[derive(Debug, Clone, Copy)]
struct Sample {
    hours: f64,
    mib: f64,
    files: usize,
}

pub(crate) fn soak(args: &SoakArgs) -> anyhow::Result<Report> {
    let mut config = settings::read(args.config.as_deref())?;
    (config.run.target_success, config.run.max_steps) = (2.0, 1_000_000_000);
    let place = args.keep.place()?;
    let title = format!(
        "A training cluster of {} actors for {} minutes after {} of warm-up, a look every {} s",
        args.actors, args.minutes, args.warm_up, args.every
    );
    let heading = ["process", "memory", "slope", "open files", "must"];
    let mut report = Report::new("soak", title, 1, &heading);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let (names, samples, status) = runtime.block_on(watch(args, &config, &place.path))?;
    runtime.shutdown_background();
    for (name, samples) in names.iter().zip(&samples) {
        let slope = slope(samples);
        let memory = |pick: fn(f64, f64) -> f64| samples.iter().map(|s| s.mib).reduce(pick).unwrap_or_default();
        let files = |at: Option<&Sample>| at.map_or(0, |sample| sample.files);
        let (first, last) = (files(samples.first()), files(samples.last()));
        let most = samples.iter().map(|s| s.files).max().unwrap_or_default();
        let cells = vec![
            name.clone(),
            format!("{:.1}–{:.1} MiB", memory(f64::min), memory(f64::max)),
            format!("{slope:+.2} MiB/h"),
            format!("{first} → {last}, at most {most}"),
            "1 MiB/h; flat".to_owned(),
        ];
        let value = json!({
            "process": name, "slope_mib_per_h": slope, "least_mib": memory(f64::min), "most_mib": memory(f64::max),
            "files_first": first, "files_last": last, "files_most": most, "samples": samples.len(),
        });
        report.row(cells, value);
    }
    report.notes.push(status);
    Ok(report)
}

type Watched = (Vec<String>, Vec<Vec<Sample>>, String);

async fn watch(
    args: &SoakArgs,
    config: &magex_core::config::RunConfig,
    place: &std::path::Path,
) -> anyhow::Result<Watched> {
    let fleet = Fleet::start(config, place, args.actors).await?;
    let processes = fleet.processes();
    let mut samples: Vec<Vec<Sample>> = processes.iter().map(|_| Vec::new()).collect();
    tokio::time::sleep(Duration::from_secs(u64::from(args.warm_up) * 60)).await;
    let (start, before) = (Instant::now(), iterations(&fleet.learner_url()).await?);
    let span = Duration::from_secs(u64::from(args.minutes) * 60);
    let mut told = 0;
    while start.elapsed() < span {
        let hours = start.elapsed().as_secs_f64() / 3600.0;
        for ((_, pid), samples) in processes.iter().zip(&mut samples) {
            samples.push(Sample { hours, mib: memory_mib(*pid, "VmRSS:"), files: open_files(*pid) });
        }
        let tenth = (10.0 * start.elapsed().as_secs_f64() / span.as_secs_f64()) as u32;
        if tenth > told {
            told = tenth;
            let now: Vec<String> = processes
                .iter()
                .zip(&samples)
                .map(|((name, _), s)| {
                    format!("{name} {:.1} MiB, {:+.2} MiB/h", s.last().map_or(0.0, |s| s.mib), slope(s))
                })
                .collect();
            note(format!("{} %: {}", 10 * tenth, now.join("; ")));
        }
        tokio::time::sleep(Duration::from_secs(args.every.into())).await;
    }
    let after = iterations(&fleet.learner_url()).await?;
    fleet.stop().await;
    let names = processes.into_iter().map(|(name, _)| name).collect();
    Ok((names, samples, format!("{} iterations in that time", after - before)))
}

async fn iterations(url: &str) -> anyhow::Result<u32> {
    let mut client = LearnerServiceClient::new(client::endpoint(url)?.connect().await?);
    let run = client.get_run(v1::GetRunRequest {}).await?.into_inner().run;
    Ok(run.map_or(0, |run| run.iteration))
}

/// MiB per hour, least squares.
fn slope(samples: &[Sample]) -> f64 {
    let count = samples.len() as f64;
    let mean = |of: fn(&Sample) -> f64| samples.iter().map(of).sum::<f64>() / count;
    let (x, y) = (mean(|s| s.hours), mean(|s| s.mib));
    let covariance: f64 = samples.iter().map(|s| (s.hours - x) * (s.mib - y)).sum();
    let variance: f64 = samples.iter().map(|s| (s.hours - x).powi(2)).sum();
    if variance > 0.0 { covariance / variance } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_leak_shows_as_its_slope() {
        let sample = |k: u32| Sample { hours: f64::from(k) / 100.0, mib: 50.0 + 3.0 * f64::from(k) / 100.0, files: 9 };
        let samples: Vec<Sample> = (0..100).map(sample).collect();
        assert!((slope(&samples) - 3.0).abs() < 1e-9);
        assert_eq!(slope(&samples[..1]), 0.0);
    }
}
