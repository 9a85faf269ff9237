//! `cluster`: throughput of the learner's wire, memory per actor, and the time of a restart.

mod actors;
mod fanout;
mod ingest;
mod load;
mod restart;

use crate::report::Report;
use crate::runs::Keep;
use crate::stats::quantile;
pub(crate) use ingest::IngestArgs;
use ingest::Learner;
pub(crate) use ingest::serve as serve_ingest;
use load::Load;
use magex::output::{note, thousands};
use magex::settings;
use serde_json::json;
use std::time::Duration;

/// Options of `cluster`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct ClusterArgs {
    /// Agents of the teams whose trajectories are sent.
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = settings::count)]
    agents: u32,
    /// Episodes of a shard: the default configuration has 1 at N = 50.
    #[arg(long, value_name = "B", default_value = "1,8", value_delimiter = ',', value_parser = settings::count)]
    episodes: Vec<u32>,
    /// Seconds of each measurement under load.
    #[arg(long, value_name = "S", default_value_t = 5, value_parser = settings::count)]
    seconds: u32,
    /// Simulated actors of the memory row.
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = settings::count)]
    actors: u32,
    /// Versions of the weights that are published to the subscribers.
    #[arg(long, value_name = "K", default_value_t = 40, value_parser = settings::count)]
    versions: u32,
    /// Times that the learner is killed.
    #[arg(long, value_name = "K", default_value_t = 5, value_parser = settings::count)]
    kills: u32,
}

pub(crate) fn cluster(args: &ClusterArgs) -> anyhow::Result<Report> {
    let title = "The cluster on loopback: a learner process that only ingests, simulated actors that send, real processes that are killed";
    let mut report = Report::new("cluster", title, 1, &["what", "measured", "must", "aim"]);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        for &episodes in &args.episodes {
            ingest_rows(&mut report, args, episodes).await?;
        }
        memory_rows(&mut report, args).await
    })?;
    drop(runtime);
    fanout_row(&mut report, args)?;
    restart_row(&mut report, args)?;
    Ok(report)
}

fn row(report: &mut Report, what: String, measured: String, [must, aim]: [&str; 2], mut value: serde_json::Value) {
    note(format!("{what}: {measured}"));
    value["what"] = what.clone().into();
    report.row(vec![what, measured, must.to_owned(), aim.to_owned()], value);
}

/// Throughput, and calls of another connection meanwhile.
async fn ingest_rows(report: &mut Report, args: &ClusterArgs, episodes: u32) -> anyhow::Result<()> {
    let load = Load::new(args.agents as usize, episodes);
    let mut learner = Learner::start(&load).await?;
    let run = actors::press(&learner.url, &load, 2, Duration::from_secs(args.seconds.into()), true).await?;
    let text = format!(
        "{}/s, {:.0} MiB/s, {}/s shards",
        thousands(run.agent_steps_per_s),
        run.mib_per_s,
        thousands(run.shards_per_s)
    );
    let value = json!({
        "agents": args.agents, "episodes": episodes, "agent_steps_per_s": run.agent_steps_per_s,
        "mib_per_s": run.mib_per_s, "shards_per_s": run.shards_per_s,
    });
    let what = format!("agent-steps ingested, N = {}, shards of {episodes} episodes, two senders", args.agents);
    row(report, what, text, ["2,000,000/s", "10,000,000/s"], value);
    let [p50, p99] = run.control_ms;
    let what = format!("… control calls meanwhile: p50 / p99 of {}", run.control_calls);
    let value = json!({ "p50_ms": p50, "p99_ms": p99, "calls": run.control_calls });
    row(report, what, format!("{p50:.2} / {p99:.2} ms"), ["25 ms", "5 ms"], value);
    learner.stop().await?;
    Ok(())
}

/// Memory with many actors over memory with one, and the time to leave them all.
async fn memory_rows(report: &mut Report, args: &ClusterArgs) -> anyhow::Result<()> {
    let load = Load::new(args.agents as usize, 1);
    let span = Duration::from_secs(args.seconds.into());
    let mut learner = Learner::start(&load).await?;
    actors::press(&learner.url, &load, 1, span, false).await?;
    let one = learner.peak_mib();
    learner.stop().await?;
    let mut learner = Learner::start(&load).await?;
    let pressing = {
        let (url, load, count) = (learner.url.clone(), load.clone(), args.actors as usize);
        tokio::spawn(async move { actors::press(&url, &load, count, span * 3, false).await })
    };
    tokio::time::sleep(span * 2).await;
    let many = learner.peak_mib();
    // All of them are still connected and sending.
    let stopped = learner.stop().await?;
    pressing.abort();
    let what = format!("{} actors connected, all sending: the learner's peak memory over that with one", args.actors);
    let value = json!({ "actors": args.actors, "one_mib": one, "many_mib": many });
    let text = format!("{:.0} MiB ({one:.0} → {many:.0})", many - one);
    row(report, what, text, ["200 MiB", "50 MiB"], value);
    let value = json!({ "seconds": stopped.as_secs_f64() });
    let text = format!("{:.2} s", stopped.as_secs_f64());
    row(report, "… SIGTERM to the end of the process".into(), text, ["10 s", "2 s"], value);
    Ok(())
}

fn fanout_row(report: &mut Report, args: &ClusterArgs) -> anyhow::Result<()> {
    let fanout = fanout::measure(args.versions)?;
    let what = format!(
        "1 MiB of weights to {} subscribers, one stalled: p50 / p95 / worst of the others, {} versions",
        fanout::SUBSCRIBERS,
        args.versions
    );
    let [p50, p95, worst] = fanout.ms;
    let text = format!("{p50:.1} / {p95:.1} / {worst:.1} ms, {} skipped", fanout.skipped);
    let value = json!({ "p50_ms": p50, "p95_ms": p95, "worst_ms": worst, "skipped": fanout.skipped });
    row(report, what, text, ["200 ms", "40 ms"], value);
    Ok(())
}

fn restart_row(report: &mut Report, args: &ClusterArgs) -> anyhow::Result<()> {
    let place = Keep::default().place()?;
    let mut times = restart::measure(&place.path, args.kills)?;
    let worst = times.iter().copied().fold(0.0, f64::max);
    let median = quantile(&mut times, 0.5);
    let what = format!("learner killed and started again → next iteration done, {} times: median / worst", args.kills);
    let value = json!({ "median_s": median, "worst_s": worst });
    row(report, what, format!("{median:.2} / {worst:.2} s"), ["10 s", "2 s"], value);
    Ok(())
}
