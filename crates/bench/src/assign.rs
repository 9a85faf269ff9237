//! `assign`: the solver alone, the quality of the learned scheduler, and the commander as a service process.

mod load;

use crate::flood::flood;
use crate::goals::learned_ratio;
use crate::report::Report;
use crate::runs::Keep;
use crate::solver::limits::limits;
use crate::solver::{distances, time_exact, uniform_points};
use crate::vitals::memory_mib;
use load::{one_client, saturate};
use magex::folder;
use magex::output::{note, thousands};
use magex::settings;
use magex::supervise::service::Service;
use magex_core::about::About;
use magex_core::config::{CommanderConfig, CommanderPolicy, RunConfig};
use magex_nets::commander::Commander;
use magex_nets::weights_file;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Agents and goals of a request.
const TEAM: usize = 50;

/// Options of `assign`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct AssignArgs {
    /// A run whose trained commander answers [default: the pairwise scorer as it begins].
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// Only the solver, without a service.
    #[arg(long)]
    solver: bool,
    /// Only the solvers at their limits: ties, clusters, 20,000 agents.
    #[arg(long)]
    limits: bool,
    /// Calls of the latency rows.
    #[arg(long, value_name = "K", default_value_t = 5000, value_parser = settings::count)]
    calls: u32,
    /// Seconds of each throughput row.
    #[arg(long, value_name = "S", default_value_t = 5, value_parser = settings::count)]
    seconds: u32,
    /// Seconds for which 64 clients flood the service.
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = settings::count)]
    flood: u32,
    /// Unseen instances of the cost ratio rows.
    #[arg(long, value_name = "K", default_value_t = 1000, value_parser = settings::count)]
    instances: u32,
    /// Python with scipy, for the ratio to its linear_sum_assignment.
    #[arg(long, value_name = "PROGRAM", default_value = "python3")]
    python: String,
}

pub(crate) fn assign(args: &AssignArgs) -> anyhow::Result<Report> {
    let title = "Goal assignment: the exact solver on one core, the learned scheduler, and the service on loopback";
    let mut report = Report::new("assign", title, 1, &["what", "measured", "must", "aim"]);
    if args.limits {
        limits(&mut report, &args.python)?;
        return Ok(report);
    }
    solver_rows(&mut report, args)?;
    if args.solver {
        return Ok(report);
    }
    let keep = Keep::default().place()?;
    let (weights, config, name) = weights(args, &keep.path)?;
    report.notes.push(format!("learned scheduler: {name}"));
    quality_rows(&mut report, args, &weights, &config)?;
    let folder = keep.path.join("served");
    std::fs::create_dir_all(&folder)?;
    std::fs::write(folder.join(folder::WEIGHTS), &weights)?;
    std::fs::write(folder.join(folder::CONFIG), config.to_toml()?)?;
    service_rows(&mut report, args, &folder)?;
    Ok(report)
}

fn row(report: &mut Report, what: &str, measured: String, must: &str, aim: &str, value: serde_json::Value) {
    note(format!("{what}: {measured}"));
    let mut value = value;
    value["what"] = what.into();
    report.row(vec![what.to_owned(), measured, must.to_owned(), aim.to_owned()], value);
}

fn solver_rows(report: &mut Report, args: &AssignArgs) -> anyhow::Result<()> {
    for (n, instances) in [(5, 2000), (20, 2000), (50, 1000), (200, 200), (1000, 20)] {
        let time = time_exact(n, instances)?;
        let compared = n >= TEAM;
        let scipy = if compared { scipy(&args.python, n, instances.min(200)) } else { Err(String::new()) };
        let (text, ratio) = match &scipy {
            Ok(theirs) => (format!("{time:.1} µs, {:.2} × scipy's {theirs:.1}", time / theirs), Some(time / theirs)),
            Err(reason) => {
                if !reason.is_empty() {
                    let reason = format!("no comparison with scipy: {reason}");
                    if !report.notes.contains(&reason) {
                        report.notes.push(reason);
                    }
                }
                (format!("{time:.1} µs"), None)
            }
        };
        let (must, aim) = if compared { ("1.0 ×", "0.5 ×") } else { ("", "") };
        let value = json!({ "agents": n, "microseconds": time, "instances": instances, "ratio_to_scipy": ratio });
        row(report, &format!("exact solve {n} × {n}, median"), text, must, aim, value);
    }
    Ok(())
}

/// Median microseconds of scipy's solver on the same matrices, in a process of its own.
fn scipy(python: &str, n: usize, instances: u32) -> Result<f64, String> {
    const SCRIPT: &str = "\
import sys, time
import numpy
from scipy.optimize import linear_sum_assignment
n = int(sys.argv[1])
data = numpy.frombuffer(sys.stdin.buffer.read(), dtype='<f8').reshape(-1, n, n)
linear_sum_assignment(data[0])
times = []
for cost in data:
    start = time.perf_counter()
    linear_sum_assignment(cost)
    times.append(time.perf_counter() - start)
print(sorted(times)[len(times) // 2] * 1e6)
";
    let mut bytes = Vec::with_capacity(instances as usize * n * n * 8);
    for index in 0..instances {
        let (agents, goals) = uniform_points(n, index);
        let cost = distances(&agents, &goals).map_err(|error| error.to_string())?;
        bytes.extend(cost.iter().flat_map(|value| value.to_le_bytes()));
    }
    let mut child = Command::new(python)
        .args(["-c", SCRIPT, &n.to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| format!("{python}: {error}"))?;
    if let Some(mut stdin) = child.stdin.take() {
        // A Python without scipy does not read; it says why below.
        let _ = std::io::Write::write_all(&mut stdin, &bytes);
    }
    let output = child.wait_with_output().map_err(|error| error.to_string())?;
    let error = || String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or("it failed").to_owned();
    let text = String::from_utf8_lossy(&output.stdout);
    text.trim().parse().map_err(|_| format!("{python}: {}", error()))
}

/// Weights that the service loads: a run's, or the pairwise scorer as it begins.
fn weights(args: &AssignArgs, place: &Path) -> anyhow::Result<(Vec<u8>, RunConfig, String)> {
    if let Some(run) = &args.run {
        let trained = folder::load(run, None)?;
        let name = format!("{}, {}", trained.config.commander.kind, trained.name);
        return Ok((trained.weights, trained.config, name));
    }
    let mut config = RunConfig::default();
    config.commander = CommanderConfig { kind: CommanderPolicy::Pairwise, ..config.commander };
    let params = Commander::init(&config.commander, config.task.agents, 2, config.run.seed)?;
    let bytes = weights_file::write(&[("commander", &params)], &About::of(&config))?;
    std::fs::create_dir_all(place)?;
    Ok((bytes, config, "pairwise, untrained; name a trained one with --run".to_owned()))
}

fn quality_rows(report: &mut Report, args: &AssignArgs, weights: &[u8], config: &RunConfig) -> anyhow::Result<()> {
    let commander = magex::local::commander(config, weights, None)?;
    for (agents, must) in [(5, "1.05"), (20, "1.08"), (50, "1.10"), (200, "1.15")] {
        let what = format!("learned cost / exact cost, N = {agents}, {} uniform instances", args.instances);
        match learned_ratio(&commander, agents, args.instances) {
            Ok([mean, worst, time]) => {
                let value = json!({ "agents": agents, "cost_ratio": mean, "worst": worst, "microseconds": time });
                let text = format!("{mean:.4} (worst {worst:.3}; {time:.0} µs)");
                row(report, &what, text, must, "1.02", value);
            }
            Err(error) => report.notes.push(format!("N = {agents}: {error:#}")),
        }
    }
    Ok(())
}

fn team(n: usize, index: u32, scheduler: v1::AssignmentMethod) -> v1::AssignRequest {
    let (agents, goals) = uniform_points(n, index);
    let points = |points: Vec<f32>| {
        Some(v1::Positions { dims: 2, coordinates: points.into_iter().map(f64::from).collect(), ..Default::default() })
    };
    let scheduler = scheduler.into();
    v1::AssignRequest { agents: points(agents), goals: points(goals), scheduler, ..Default::default() }
}

fn service_rows(report: &mut Report, args: &AssignArgs, folder: &Path) -> anyhow::Result<()> {
    // One client waits for its answer and does nothing else: one thread, as in a program that asks. Many share two.
    let one = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let many = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let weights = folder.display().to_string();
    let arguments = ["commander", "--listen", "127.0.0.1:0", "--weights", &weights];
    let mut service = many.block_on(Service::new("commander", &arguments, folder).start())?;
    let url = format!("http://{}", service.address);
    for (kind, name, must, aim) in [
        (v1::AssignmentMethod::Exact, "EXACT", ["0.5 / 3 ms", "4,000/s"], ["0.2 / 1 ms", "15,000/s"]),
        (v1::AssignmentMethod::Learned, "LEARNED", ["2 / 8 ms", "800/s"], ["0.6 / 2 ms", "4,000/s"]),
    ] {
        let teams: Vec<v1::AssignRequest> = (0..64).map(|k| team(TEAM, k, kind)).collect();
        let [p50, p99, inside] = one.block_on(one_client(&url, &teams, args.calls, kind))?;
        let what = format!("Assign {name}, {TEAM} × {TEAM}, one client: p50 / p99");
        let value = json!({ "p50_ms": p50, "p99_ms": p99, "service_p50_ms": inside });
        row(report, &what, format!("{p50:.3} / {p99:.3} ms (inside {inside:.3})"), must[0], aim[0], value);
        let rate = many.block_on(saturate(&url, &teams, args.seconds, kind))?;
        let what = format!("Assign {name}, {TEAM} × {TEAM}, at saturation");
        row(report, &what, format!("{}/s", thousands(rate)), must[1], aim[1], json!({ "calls_per_s": rate }));
    }
    let teams: Vec<v1::AssignRequest> = (0..64).map(|k| team(TEAM, k, v1::AssignmentMethod::Exact)).collect();
    let assign = move |channel, number: usize| {
        let (mut client, request) = (CommanderServiceClient::new(channel), teams[number % teams.len()].clone());
        async move { client.assign(request).await.map(drop) }
    };
    let what = format!("Assign EXACT, {TEAM} × {TEAM}");
    many.block_on(flood(&url, service.id(), args.flood, assign))?.report(report, &what, args.flood);
    many.block_on(service.stop());
    let mut service = many.block_on(Service::new("commander", &arguments[..3], folder).start())?;
    let url = format!("http://{}", service.address);
    for (kind, name) in [(v1::AssignmentMethod::Exact, "EXACT"), (v1::AssignmentMethod::Makespan, "MAKESPAN")] {
        let [seconds, ..] = one.block_on(one_client(&url, &[team(5000, 0, kind)], 1, kind))?;
        let (seconds, peak) = (seconds / 1e3, memory_mib(service.id(), "VmHWM:"));
        let text = format!("{seconds:.1} s, {peak:.0} MiB");
        let value = json!({ "seconds": seconds, "peak_mib": peak });
        row(report, &format!("{name}, 5,000 × 5,000"), text, "20 s, 1,024 MiB", "3 s", value);
    }
    many.block_on(service.stop());
    Ok(())
}
