//! `endless`: a mission whose goals never end. Its memory and the time of its updates must not grow.

use crate::report::Report;
use crate::runs::Keep;
use crate::stats::quantile;
use crate::vitals::memory_mib;
use anyhow::Context as _;
use magex::output::thousands;
use magex::settings;
use magex::supervise::service::Service;
use magex_core::rng::{Key, Purpose};
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client;
use serde_json::json;
use std::time::Instant;

/// Robots, and goals that are finished and added in every update.
const ROBOTS: u32 = 20;
/// Goals after which a row begins, and updates of which a row takes the median.
const FROM: u32 = 10_000;
const WINDOW: usize = 500;

/// Options of `endless`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct EndlessArgs {
    /// Goals of the mission, all in all.
    #[arg(long, value_name = "K", default_value_t = 1_000_000, value_parser = settings::count)]
    goals: u32,
}

pub(crate) fn endless(args: &EndlessArgs) -> anyhow::Result<Report> {
    let title = format!("A mission on disk: {ROBOTS} robots, {ROBOTS} goals finished and {ROBOTS} new in every update");
    let mut report = Report::new("endless", title, 1, &["goals", "update p50 ms", "peak memory MiB"]);
    let keep = Keep::default().place()?;
    let data = keep.path.join("data").display().to_string();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let arguments = ["commander", "--listen", "127.0.0.1:0", "--data", &data];
    let mut service = runtime.block_on(Service::new("commander", &arguments, &keep.path).start())?;
    let rows = runtime.block_on(run(args, &format!("http://{}", service.address), service.id()));
    runtime.block_on(service.stop());
    let rows = rows?;
    for &(goals, ms, mib) in &rows {
        let value = json!({ "goals": goals, "update_p50_ms": ms, "peak_mib": mib });
        report.row(vec![thousands(goals.into()), format!("{ms:.3}"), format!("{mib:.1}")], value);
    }
    if let [(_, ms, mib), .., (_, last_ms, last_mib)] = rows[..] {
        report.notes.push(format!("end over begin: update {:.2} x, memory {:.2} x", last_ms / ms, last_mib / mib));
    }
    Ok(report)
}

async fn run(args: &EndlessArgs, url: &str, process: u32) -> anyhow::Result<Vec<(u32, f64, f64)>> {
    let channel = client::endpoint(url)?.connect().await.with_context(|| format!("connecting to {url}"))?;
    let mut client = CommanderServiceClient::new(channel);
    let mut stream = Key::new(1, Purpose::Bench, &[7]).stream();
    let mut member = |id: String| {
        let position = vec![stream.range(0.0, 100.0), stream.range(0.0, 100.0)];
        v1::Member { id, position, ..Default::default() }
    };
    let agents = (0..ROBOTS).map(|k| member(format!("robot-{k}"))).collect();
    let request = v1::CreateMissionRequest { agents, ..Default::default() };
    let mut assignment = client.create_mission(request).await?.into_inner().assignment.context("no assignment")?;
    let mission_id = assignment.mission_id.clone();
    let (mut made, mut times, mut rows) = (0, Vec::new(), Vec::new());
    let mut next = FROM;
    while made < args.goals {
        let done = assignment.pairs.drain(..).map(|pair| v1::Member {
            id: pair.goal_id,
            state: v1::MemberState::Finished.into(),
            ..Default::default()
        });
        let new = (made..made + ROBOTS).map(|k| member(format!("goal-{k}")));
        let goals = done.chain(new).collect();
        let update = v1::UpdateMissionRequest { mission_id: mission_id.clone(), goals, ..Default::default() };
        let start = Instant::now();
        assignment = client.update_mission(update).await?.into_inner().assignment.context("no assignment")?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
        made += ROBOTS;
        if made >= next || made >= args.goals {
            let recent = times.len().saturating_sub(WINDOW);
            rows.push((made, quantile(&mut times[recent..], 0.5), memory_mib(process, "VmHWM:")));
            times.clear();
            next = made.saturating_mul(3).min(args.goals);
        }
    }
    Ok(rows)
}
