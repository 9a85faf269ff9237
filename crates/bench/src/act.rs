//! `act`: the policy as a service process: latency of one client, calls per second of eight.

use crate::flood::flood;
use crate::report::Report;
use crate::runs::Keep;
use crate::stats::quantile;
use anyhow::Context as _;
use magex::folder;
use magex::output::{note, thousands};
use magex::settings;
use magex::supervise::service::Service;
use magex_core::about::About;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_nets::executor::Model;
use magex_nets::params::Params;
use magex_nets::weights_file;
use magex_proto::v1;
use magex_proto::v1::policy_service_client::PolicyServiceClient;
use magex_runtime::client;
use serde_json::json;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tonic::transport::Channel;

/// Clients of the throughput rows, each with a connection of its own and one call at a time.
const CLIENTS: usize = 8;

/// Options of `act`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct ActArgs {
    /// A run whose policy acts [default: magex and local for 50 agents, as they begin].
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// Calls of the latency rows.
    #[arg(long, value_name = "K", default_value_t = 5000, value_parser = settings::count)]
    calls: u32,
    /// Seconds of each throughput row.
    #[arg(long, value_name = "S", default_value_t = 5, value_parser = settings::count)]
    seconds: u32,
    /// Seconds of each flood by 64 clients.
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = settings::count)]
    flood: u32,
}

pub(crate) fn act(args: &ActArgs) -> anyhow::Result<Report> {
    let title = "Acting over loopback: one step of one team per call";
    let mut report = Report::new("act", title, 1, &["what", "measured", "must", "aim"]);
    let keep = Keep::default().place()?;
    let subjects = match &args.run {
        Some(run) => {
            let trained = folder::load(run, None)?;
            vec![(trained.config, trained.weights)]
        }
        None => vec![fresh(ExecutorKind::Magex)?, fresh(ExecutorKind::Local)?],
    };
    for (config, weights) in subjects {
        let place = keep.path.join(config.executor.kind.to_string());
        std::fs::create_dir_all(&place)?;
        std::fs::write(place.join(folder::WEIGHTS), &weights)?;
        std::fs::write(place.join(folder::CONFIG), config.to_toml()?)?;
        rows(&mut report, args, &config, &place)?;
    }
    Ok(report)
}

/// Weights as they begin: what they compute costs as much as what trained ones do.
fn fresh(kind: ExecutorKind) -> anyhow::Result<(RunConfig, Vec<u8>)> {
    let mut config = RunConfig::default();
    config.executor.kind = kind;
    config.commander.kind = magex_core::config::CommanderPolicy::Exact;
    let model = Model::new(&config)?;
    let drawn: Vec<Params> = (0..)
        .zip(model.layouts()?)
        .map(|(part, layout)| Params::init(layout, Key::new(1, Purpose::Init, &[part]).stream()))
        .collect();
    let named: Vec<(&str, &Params)> = model.parts().iter().map(|part| part.name).zip(&drawn).collect();
    let weights = weights_file::write(&named, &About::of(&config))?;
    Ok((config, weights))
}

fn rows(report: &mut Report, args: &ActArgs, config: &RunConfig, place: &std::path::Path) -> anyhow::Result<()> {
    let one = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let many = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let weights = place.display().to_string();
    let arguments = ["commander", "--listen", "127.0.0.1:0", "--weights", &weights];
    let mut service = many.block_on(Service::new("commander", &arguments, place).start())?;
    let url = format!("http://{}", service.address);
    let (name, n) = (config.executor.kind, config.task.agents);
    let [p50, p99] = one.block_on(one_client(&url, config, args.calls))?;
    let rate = many.block_on(saturate(&url, config, args.seconds))?;
    let mut row = |what: String, measured: String, must: &str, aim: &str, mut value: serde_json::Value| {
        note(format!("{what}: {measured}"));
        value["what"] = what.clone().into();
        report.row(vec![what, measured, must.to_owned(), aim.to_owned()], value);
    };
    let what = format!("Act, {name}, N = {n}, one client: p50 / p99");
    let value = json!({ "p50_ms": p50, "p99_ms": p99 });
    row(what, format!("{p50:.3} / {p99:.3} ms"), "1 / 5 ms", "0.3 / 1 ms", value);
    let what = format!("Act, {name}, N = {n}, {CLIENTS} clients");
    row(what, format!("{}/s", thousands(rate)), "3,000/s", "10,000/s", json!({ "calls_per_s": rate }));
    // A team as trained, and one whose calls do not stay on the thread that accepts others.
    for n in [n, 256] {
        let steps: Vec<v1::ActRequest> = (0..16).map(|k| step(config, n, k)).collect();
        let call = move |channel, number: usize| {
            let (mut client, request) = (PolicyServiceClient::new(channel), steps[number % steps.len()].clone());
            async move { client.act(request).await.map(drop) }
        };
        let what = format!("Act, {name}, N = {n}");
        many.block_on(flood(&url, service.id(), args.flood, call))?.report(report, &what, args.flood);
    }
    many.block_on(service.stop());
    Ok(())
}

async fn connect(url: &str) -> anyhow::Result<PolicyServiceClient<Channel>> {
    let channel = client::endpoint(url)?.connect().await.with_context(|| format!("connecting to {url}"))?;
    Ok(PolicyServiceClient::new(channel))
}

/// The first step of a team that is anywhere on the map.
fn step(config: &RunConfig, n: usize, index: u32) -> v1::ActRequest {
    let task = &config.task;
    let mut stream = Key::new(5, Purpose::Bench, &[index]).stream();
    let half = f64::from(task.side / 2.0);
    let mut within =
        |limit: f64, width: usize| -> Vec<f32> { (0..n * width).map(|_| stream.range(-limit, limit) as f32).collect() };
    let (d, balls) = (task.dims(), if task.balls() > 0 { task.dims() } else { 0 });
    v1::ActRequest {
        dims: d as u32,
        positions: within(half, d),
        velocities: within(1.0, d),
        goals: within(half, d),
        balls: within(half, balls),
        ball_velocities: within(1.0, balls),
        agent_state: vec![0.0; n * task.agent_state()],
        ..Default::default()
    }
}

/// Median and 99th percentile of the round trip, milliseconds; the memory goes on from call to call.
async fn one_client(url: &str, config: &RunConfig, calls: u32) -> anyhow::Result<[f64; 2]> {
    let mut client = connect(url).await?;
    let steps: Vec<v1::ActRequest> = (0..64).map(|k| step(config, config.task.agents, k)).collect();
    let (mut times, mut memory) = (Vec::new(), Default::default());
    // The first calls find cold caches.
    for call in 0..100 + calls {
        let request = v1::ActRequest { memory, ..steps[call as usize % steps.len()].clone() };
        let start = Instant::now();
        let answer = client.act(request).await?.into_inner();
        if call >= 100 {
            times.push(start.elapsed().as_secs_f64() * 1e3);
        }
        memory = answer.memory;
    }
    Ok([quantile(&mut times, 0.5), quantile(&mut times, 0.99)])
}

/// Calls per second of all clients.
async fn saturate(url: &str, config: &RunConfig, seconds: u32) -> anyhow::Result<f64> {
    let start = Instant::now();
    let until = start + Duration::from_secs(seconds.into());
    let mut tasks = Vec::new();
    for k in 0..CLIENTS {
        let (mut client, first) = (connect(url).await?, step(config, config.task.agents, k as u32));
        tasks.push(tokio::spawn(async move {
            let (mut calls, mut memory) = (0u64, Default::default());
            while Instant::now() < until {
                memory = client.act(v1::ActRequest { memory, ..first.clone() }).await?.into_inner().memory;
                calls += 1;
            }
            anyhow::Ok(calls)
        }));
    }
    let mut calls = 0;
    for task in tasks {
        calls += task.await??;
    }
    Ok(calls as f64 / start.elapsed().as_secs_f64())
}
