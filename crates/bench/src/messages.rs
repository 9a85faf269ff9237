//! `messages`: how long a health check waits at a commander that other clients send messages of 31 MiB.

use crate::report::Report;
use crate::runs::Keep;
use crate::stats::quantile;
use crate::vitals::memory_mib;
use anyhow::Context as _;
use bytes::{Buf as _, BufMut as _, Bytes};
use magex::output::note;
use magex::settings;
use magex::supervise::service::Service;
use magex_proto::v1;
use magex_runtime::client;
use serde_json::json;
use std::time::{Duration, Instant};
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// Bytes of a message.
const LENGTH: usize = 31 << 20;
/// Pause between two health checks.
const PAUSE: Duration = Duration::from_millis(5);

/// Options of `messages`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct MessagesArgs {
    /// Clients, each with a connection of its own.
    #[arg(long, value_name = "K", default_value_t = 8, value_parser = settings::count)]
    clients: u32,
    /// Seconds of each row.
    #[arg(long, value_name = "S", default_value_t = 12, value_parser = settings::count)]
    seconds: u32,
    /// A commander that runs, such as that of another release, in place of one that is started here.
    #[arg(long, value_name = "URL")]
    connect: Option<String>,
}

pub(crate) fn messages(args: &MessagesArgs) -> anyhow::Result<Report> {
    let title =
        format!("Health checks beside {} clients that send messages of 31 MiB, for {} s", args.clients, args.seconds);
    let heading = ["messages", "answered", "refused", "health p50 / p99 / worst, ms", "peak, MiB", "must, p99", "aim"];
    let mut report = Report::new("messages", title, 1, &heading);
    let keep = Keep::default().place()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let (mut service, url) = match &args.connect {
        Some(url) => (None, url.clone()),
        None => {
            let arguments = ["commander", "--listen", "127.0.0.1:0"];
            let service = runtime.block_on(Service::new("commander", &arguments, &keep.path).start())?;
            let url = format!("http://{}", service.address);
            (Some(service), url)
        }
    };
    for (name, message) in
        [("none", None), ("a matrix of costs", Some(matrix())), ("positions, too many", Some(positions()))]
    {
        let measured = beside(&runtime, args, &url, message)?;
        let [p50, p99, worst] = measured.health;
        let peak = service.as_ref().map_or(0.0, |service| memory_mib(service.id(), "VmHWM:"));
        note(format!("{name}: health p99 {p99:.1} ms"));
        let cells = [
            name.to_owned(),
            measured.answered.to_string(),
            measured.refused.to_string(),
            format!("{p50:.1} / {p99:.1} / {worst:.1}"),
            format!("{peak:.0}"),
            "25".to_owned(),
            "10".to_owned(),
        ];
        let value = json!({
            "messages": name, "answered": measured.answered, "refused": measured.refused, "p50_ms": p50, "p99_ms": p99,
            "worst_ms": worst, "peak_mib": peak,
        });
        report.row(cells.into(), value);
    }
    if let Some(service) = &mut service {
        runtime.block_on(service.stop());
    }
    Ok(report)
}

struct Measured {
    answered: u32,
    refused: u32,
    /// Median, 99th percentile and worst, milliseconds.
    health: [f64; 3],
}

/// Senders on the runtime, the health check on a thread of its own, so that it does not wait for senders.
fn beside(
    runtime: &tokio::runtime::Runtime,
    args: &MessagesArgs,
    url: &str,
    message: Option<Bytes>,
) -> anyhow::Result<Measured> {
    let until = Instant::now() + Duration::from_secs(args.seconds.into());
    let senders: Vec<_> = message
        .iter()
        .flat_map(|message| (0..args.clients).map(|_| runtime.spawn(send(url.to_owned(), message.clone(), until))))
        .collect();
    let probe = {
        let url = url.to_owned();
        std::thread::spawn(move || {
            tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(check(url, until))
        })
    };
    let (mut answered, mut refused) = (0, 0);
    for sender in senders {
        let (yes, no) = runtime.block_on(sender)??;
        (answered, refused) = (answered + yes, refused + no);
    }
    let mut times = probe.join().map_err(|_| anyhow::anyhow!("the health check panicked"))??;
    let health = [0.5, 0.99, 1.0].map(|q| quantile(&mut times, q));
    Ok(Measured { answered, refused, health })
}

/// Milliseconds of health checks on one connection.
async fn check(url: String, until: Instant) -> anyhow::Result<Vec<f64>> {
    let mut health = HealthClient::new(client::endpoint(&url)?.connect().await?);
    let mut times = Vec::new();
    while Instant::now() < until {
        let start = Instant::now();
        health.check(HealthCheckRequest::default()).await?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
        tokio::time::sleep(PAUSE).await;
    }
    Ok(times)
}

/// Sends the message again and again. Counts answers and refusals.
async fn send(url: String, message: Bytes, until: Instant) -> anyhow::Result<(u32, u32)> {
    let mut client = tonic::client::Grpc::new(client::endpoint(&url)?.connect().await?);
    let (mut answered, mut refused) = (0, 0);
    while Instant::now() < until {
        client.ready().await?;
        let path = "/magex.v1.CommanderService/Assign".parse().context("a path")?;
        let call = client.unary(tonic::Request::new(message.clone()), path, Raw);
        match tokio::time::timeout_at(until.into(), call).await {
            Ok(Ok(_)) => answered += 1,
            Ok(Err(status))
                if [Code::ResourceExhausted, Code::InvalidArgument, Code::DeadlineExceeded]
                    .contains(&status.code()) =>
            {
                refused += 1;
            }
            Ok(Err(status)) => return Err(status.into()),
            Err(_) => break,
        }
    }
    Ok((answered, refused))
}

/// As many costs as a message takes: a valid request.
fn matrix() -> Bytes {
    let side = (LENGTH / 8).isqrt() as u32;
    let values = (0..side * side).map(|at| f64::from(at.wrapping_mul(2_654_435_761) >> 8)).collect();
    let costs = v1::CostMatrix { agents: side, goals: side, values };
    let scheduler = v1::AssignmentMethod::Greedy.into();
    encoded(&v1::AssignRequest { costs: Some(costs), scheduler, ..Default::default() })
}

/// More agents than a team may have.
fn positions() -> Bytes {
    let points = || Some(v1::Positions { dims: 2, coordinates: vec![1.0; LENGTH / 16], ..Default::default() });
    encoded(&v1::AssignRequest { agents: points(), goals: points(), ..Default::default() })
}

fn encoded(message: &impl prost::Message) -> Bytes {
    message.encode_to_vec().into()
}

/// Bytes that are encoded once.
#[derive(Debug, Default, Clone, Copy)]
struct Raw;

impl Codec for Raw {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, frame: &mut EncodeBuf<'_>) -> Result<(), Status> {
        frame.put(item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, frame: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        Ok(Some(frame.copy_to_bytes(frame.remaining())))
    }
}
