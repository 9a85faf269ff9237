//! One environment and the stream to it. Every wait has an end: a process that hangs is lost.

use super::description::{self, PROTOCOL};
use super::observed::{Observed, Taken};
use super::process::Process;
use super::{EnvironmentError, How};
use magex_core::task::ExternalConfig;
use magex_proto::v1;
use magex_proto::v1::EnvironmentProblemKind as Kind;
use magex_proto::v1::environment_reply::Reply;
use magex_proto::v1::environment_request::Request as Body;
use magex_proto::v1::environment_service_client::EnvironmentServiceClient;
use magex_runtime::client::{Channel, Settings, connect_local, root_of};
use std::time::{Duration, Instant};
use tokio::runtime::Runtime;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

/// Longest message of either side, bytes: the observations of all worlds of a shard travel in one.
const MAX_MESSAGE_BYTES: usize = 256 << 20;
/// Time between two attempts to reach a process that starts.
const KNOCK: Duration = Duration::from_millis(20);

/// An environment with W worlds of this caller's own.
#[derive(Debug)]
pub struct Environment {
    description: ExternalConfig,
    /// Steps after which it ends an episode by itself; 0 if it does not say.
    steps_max: u32,
    timeout: Duration,
    /// W.
    worlds: usize,
    client: EnvironmentServiceClient<Channel>,
    requests: mpsc::Sender<v1::EnvironmentRequest>,
    /// `None` until the first request: a server in Python sends the head of its answer with the first answer.
    replies: Option<tonic::Streaming<v1::EnvironmentReply>>,
    /// What the stream of requests is made of, until then.
    unsent: Option<mpsc::Receiver<v1::EnvironmentRequest>>,
    /// The calls of one thread: they run on it.
    runtime: Runtime,
    /// Last: it ends after the connection.
    process: Option<Process>,
}

impl Environment {
    pub(super) fn open(how: &How, settings: &Settings, timeout: Duration) -> Result<Self, EnvironmentError> {
        let lost = |error: String| EnvironmentError::Lost(error);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(|error| lost(format!("its connection needs a runtime: {error}")))?;
        let mut process = match how {
            How::Command(command) => Some(Process::start(command)?),
            How::Socket(_) | How::Url(_) => None,
        };
        let begun = Instant::now();
        let channel = loop {
            let connected = runtime.block_on(async {
                let connecting = async {
                    match (how, &process) {
                        (How::Url(url), _) => settings.connect(url).await.map_err(|error| error.to_string()),
                        (How::Socket(path), _) => connect_local(path).await.map_err(|error| error.to_string()),
                        (How::Command(_), Some(process)) => {
                            connect_local(&process.socket).await.map_err(|error| error.to_string())
                        }
                        (How::Command(_), None) => Err("it was not started".to_owned()),
                    }
                };
                tokio::time::timeout(timeout, connecting).await.unwrap_or_else(|_| Err("no answer".to_owned()))
            });
            match connected {
                Ok(channel) => break channel,
                Err(problem) => {
                    if let Some(ended) = process.as_mut().and_then(Process::ended) {
                        return Err(lost(ended));
                    }
                    if process.is_none() || begun.elapsed() >= timeout {
                        let seconds = timeout.as_secs();
                        return Err(lost(format!("it could not be reached within {seconds} s: {problem}")));
                    }
                    std::thread::sleep(KNOCK);
                }
            }
        };
        let mut client = EnvironmentServiceClient::new(channel)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        let (requests, received) = mpsc::channel(1);
        let opened = runtime.block_on(async {
            tokio::time::timeout(timeout, client.describe(v1::DescribeRequest { protocol: PROTOCOL })).await
        });
        let described = match opened {
            Ok(Ok(described)) => described.into_inner(),
            Ok(Err(status)) => return Err(gone(process.as_mut(), &status)),
            Err(_) => return Err(lost(format!("it did not describe itself within {} s", timeout.as_secs()))),
        };
        let (description, steps_max) = (description::read(&described)?, described.steps_max);
        let (replies, unsent) = (None, Some(received));
        Ok(Self { description, steps_max, timeout, worlds: 0, client, requests, replies, unsent, runtime, process })
    }

    /// What it says about itself.
    pub fn description(&self) -> &ExternalConfig {
        &self.description
    }

    /// Steps after which it ends an episode by itself; 0 if it does not say.
    pub fn steps_max(&self) -> u32 {
        self.steps_max
    }

    /// Begins an episode in each of as many worlds as there are seeds.
    pub fn reset(&mut self, seeds: Vec<u32>) -> Result<Observed, EnvironmentError> {
        self.worlds = seeds.len();
        self.observed(Body::Reset(v1::EnvironmentReset { seeds, options: String::new() }))
    }

    /// One step of all worlds; `restarts` are worlds that begin a new episode in place of it, with their seeds.
    pub fn step(&mut self, taken: &Taken<'_>, restarts: &[(u32, u32)]) -> Result<Observed, EnvironmentError> {
        let restarts = restarts.iter().map(|&(world, seed)| v1::Restart { world, seed }).collect();
        let actions = Some(taken.to_array(&self.description, self.worlds));
        self.observed(Body::Step(v1::EnvironmentStep { actions, restarts }))
    }

    /// A picture of a world as a PNG file.
    pub fn render(&mut self, world: u32) -> Result<Vec<u8>, EnvironmentError> {
        match self.ask(Body::Render(v1::EnvironmentRender { world }))? {
            Reply::Picture(picture) if picture.png.starts_with(b"\x89PNG") => Ok(picture.png.into()),
            Reply::Picture(_) => Err(EnvironmentError::BrokeItsWord("its picture is no PNG file".to_owned())),
            _ => Err(out_of_turn()),
        }
    }

    /// Lets it look for what it does that its interface forbids. Plays some episodes: `timeout` is the limit of all of them.
    pub fn check(&mut self, seed: u32, steps: u32, timeout: Duration) -> Result<v1::CheckReply, EnvironmentError> {
        let (runtime, client) = (&self.runtime, &mut self.client);
        let checking = client.check(v1::CheckRequest { seed, steps });
        match runtime.block_on(async { tokio::time::timeout(timeout, checking).await }) {
            Ok(Ok(reply)) => Ok(reply.into_inner()),
            Ok(Err(status)) => Err(gone(self.process.as_mut(), &status)),
            Err(_) => Err(EnvironmentError::Lost(format!("its check took more than {} s", timeout.as_secs()))),
        }
    }

    fn observed(&mut self, request: Body) -> Result<Observed, EnvironmentError> {
        match self.ask(request)? {
            Reply::Observed(observed) => Observed::read(observed, &self.description, self.worlds),
            _ => Err(out_of_turn()),
        }
    }

    fn ask(&mut self, request: Body) -> Result<Reply, EnvironmentError> {
        let what = match &request {
            Body::Reset(_) => "reset",
            Body::Step(_) => "step",
            Body::Render(_) => "render",
        };
        let (requests, replies, unsent, client) =
            (&self.requests, &mut self.replies, &mut self.unsent, &mut self.client);
        let answer = self.runtime.block_on(async {
            let asking = async {
                let request = v1::EnvironmentRequest { request: Some(request) };
                requests.send(request).await.map_err(|_| Status::unavailable("its connection is closed"))?;
                if let Some(unsent) = unsent.take() {
                    *replies = Some(client.run(ReceiverStream::new(unsent)).await?.into_inner());
                }
                match replies {
                    Some(replies) => replies.message().await,
                    None => Err(Status::unavailable("its connection is closed")),
                }
            };
            tokio::time::timeout(self.timeout, asking).await
        });
        let reply = match answer {
            Ok(Ok(Some(reply))) => reply.reply,
            Ok(Ok(None)) => return Err(gone(self.process.as_mut(), &Status::unavailable("it ended the connection"))),
            Ok(Err(status)) => return Err(gone(self.process.as_mut(), &status)),
            Err(_) => {
                let seconds = self.timeout.as_secs_f64();
                return Err(EnvironmentError::Lost(format!("it did not answer a {what} within {seconds} s")));
            }
        };
        match reply {
            Some(Reply::Problem(problem)) => Err(match problem.kind() {
                Kind::Raised => EnvironmentError::Raised(problem.message),
                Kind::BrokeItsWord | Kind::Request | Kind::Unspecified => {
                    EnvironmentError::BrokeItsWord(problem.message)
                }
            }),
            Some(reply) => Ok(reply),
            None => Err(out_of_turn()),
        }
    }
}

fn out_of_turn() -> EnvironmentError {
    EnvironmentError::BrokeItsWord("it sent an answer to another request".to_owned())
}

/// What a failed call means: its process has ended, or says why itself.
fn gone(process: Option<&mut Process>, status: &Status) -> EnvironmentError {
    let ended = process.and_then(|process| {
        // The connection breaks a moment before the process is gone.
        std::thread::sleep(Duration::from_millis(50));
        process.ended()
    });
    // A failed connection says why in its innermost error only.
    let reason = match std::error::Error::source(status) {
        Some(source) => root_of(source),
        None => status.message().to_owned(),
    };
    EnvironmentError::Lost(ended.unwrap_or_else(|| format!("{}: {reason}", status.code())))
}
