//! A relay that understands the protocol: between actors and a learner it repeats, reorders and damages messages, in an order
//! that a seed decides.

use bytes::Bytes;
use magex_core::rng::{Key, Purpose, Stream};
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::learner_service_server::{LearnerService, LearnerServiceServer};
use magex_proto::v1::rollout_request::Message as Said;
use magex_proto::v1::rollout_response::Message as Answered;
use magex_proto::{MAX_MESSAGE_BYTES, v1};
use magex_runtime::{client, server};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::thread::JoinHandle;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Request, Response, Status, Streaming};

/// How many messages of each kind of mischief came of it.
#[derive(Debug, Default)]
pub struct Mischief {
    /// Sent twice.
    pub repeated: AtomicU64,
    /// Sent after what came later.
    pub reordered: AtomicU64,
    /// Sent with a flipped bit.
    pub damaged: AtomicU64,
}

/// The relay; ends when dropped.
#[derive(Debug)]
pub struct Relay {
    address: String,
    /// What was done so far.
    pub mischief: Arc<Mischief>,
    stop: Option<watch::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Relay {
    /// In front of the learner at `upstream` (`host:port`).
    pub fn start(upstream: &str, seed: u64) -> Self {
        let mischief = Arc::new(Mischief::default());
        let (url, done) = (format!("http://{upstream}"), mischief.clone());
        let (stop, mut stopped) = watch::channel(());
        let (tell, told) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(async move {
                let learner = client::endpoint(&url).expect("an address").connect_lazy();
                let middle = Middle { learner, seed, connections: Arc::default(), mischief: done };
                let (incoming, address) = server::bind("127.0.0.1:0").await.expect("a free port");
                tell.send(address.to_string()).expect("the test waits for the address");
                let service = LearnerServiceServer::new(middle).max_decoding_message_size(MAX_MESSAGE_BYTES);
                tokio::select! {
                    served = server::builder().add_service(service).serve_with_incoming(incoming) => {
                        served.expect("the relay serves");
                    }
                    _ = stopped.changed() => {}
                }
            });
        });
        let address = told.recv().expect("the relay's address");
        Self { address, mischief, stop: Some(stop), thread: Some(thread) }
    }

    /// Where it listens, `host:port`.
    pub fn address(&self) -> &str {
        &self.address
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.stop = None;
        if let Some(thread) = self.thread.take() {
            // A panic in there has been printed.
            let _ = thread.join();
        }
    }
}

struct Middle {
    learner: Channel,
    seed: u64,
    connections: Arc<AtomicU32>,
    mischief: Arc<Mischief>,
}

impl Middle {
    fn client(&self) -> LearnerServiceClient<Channel> {
        LearnerServiceClient::new(self.learner.clone()).max_decoding_message_size(MAX_MESSAGE_BYTES)
    }

    fn stream(&self, connection: u32, direction: u32) -> Stream {
        Key::new(self.seed, Purpose::Request, &[connection, direction]).stream()
    }
}

/// Passes messages on. What is held back comes after the next one.
async fn pass<T: Clone>(
    mut from: Streaming<T>,
    to: mpsc::Sender<T>,
    mut stream: Stream,
    mischief: Arc<Mischief>,
    touch: fn(&mut T, &mut Stream) -> Touch,
) -> Option<Status> {
    let mut held: Option<T> = None;
    loop {
        let message = match from.message().await {
            Ok(Some(message)) => message,
            Ok(None) => return None,
            Err(status) => return Some(status),
        };
        let mut message = message;
        let (mut out, mut later) = (Vec::new(), None);
        match touch(&mut message, &mut stream) {
            Touch::Pass => out.push(message),
            Touch::Damaged => {
                mischief.damaged.fetch_add(1, Ordering::SeqCst);
                out.push(message);
            }
            Touch::Repeat => {
                mischief.repeated.fetch_add(1, Ordering::SeqCst);
                out.extend([message.clone(), message]);
            }
            Touch::HoldBack => later = Some(message),
        }
        if let Some(earlier) = held.take() {
            mischief.reordered.fetch_add(1, Ordering::SeqCst);
            out.push(earlier);
        }
        held = later;
        for message in out {
            if to.send(message).await.is_err() {
                return None;
            }
        }
    }
}

enum Touch {
    Pass,
    Repeat,
    HoldBack,
    Damaged,
}

/// What actors say: results in parts are repeated, reordered and damaged.
fn said(message: &mut v1::RolloutRequest, stream: &mut Stream) -> Touch {
    let Some(Said::Part(part)) = &mut message.message else { return Touch::Pass };
    match stream.bits32() % 100 {
        0..15 => Touch::Repeat,
        15..22 => Touch::HoldBack,
        22..26 => {
            if let Some(part) = &mut part.part {
                let mut data = part.data.to_vec();
                let place = stream.bits32() as usize % data.len().max(1);
                data[place] ^= 1 << (stream.bits32() % 8);
                part.data = Bytes::from(data);
            }
            Touch::Damaged
        }
        _ => Touch::Pass,
    }
}

/// What the learner says: leases are repeated.
fn answered(message: &mut v1::RolloutResponse, stream: &mut Stream) -> Touch {
    let lease = matches!(message.message, Some(Answered::Lease(_)));
    if lease && stream.bits32().is_multiple_of(10) { Touch::Repeat } else { Touch::Pass }
}

#[tonic::async_trait]
impl LearnerService for Middle {
    type RolloutStream = ReceiverStream<Result<v1::RolloutResponse, Status>>;

    async fn rollout(
        &self,
        request: Request<Streaming<v1::RolloutRequest>>,
    ) -> Result<Response<Self::RolloutStream>, Status> {
        let connection = self.connections.fetch_add(1, Ordering::SeqCst);
        let (there, requests) = mpsc::channel(4);
        let (back, responses) = mpsc::channel(4);
        tokio::spawn(pass(request.into_inner(), there, self.stream(connection, 0), self.mischief.clone(), said));
        let answers = self.client().rollout(ReceiverStream::new(requests)).await?.into_inner();
        let (stream, mischief) = (self.stream(connection, 1), self.mischief.clone());
        let (plain, mut passed) = mpsc::channel(1);
        tokio::spawn(async move {
            let forward = async {
                while let Some(message) = passed.recv().await {
                    if back.send(Ok(message)).await.is_err() {
                        return;
                    }
                }
            };
            let (end, ()) = tokio::join!(pass(answers, plain, stream, mischief, answered), forward);
            if let Some(status) = end {
                // The actor may have left.
                let _ = back.send(Err(status)).await;
            }
        });
        Ok(Response::new(ReceiverStream::new(responses)))
    }

    type WatchWeightsStream = Streaming<v1::WatchWeightsResponse>;

    async fn watch_weights(
        &self,
        request: Request<v1::WatchWeightsRequest>,
    ) -> Result<Response<Self::WatchWeightsStream>, Status> {
        self.client().watch_weights(request.into_inner()).await
    }

    async fn get_run(&self, request: Request<v1::GetRunRequest>) -> Result<Response<v1::GetRunResponse>, Status> {
        self.client().get_run(request.into_inner()).await
    }

    type WatchRunStream = Streaming<v1::WatchRunResponse>;

    async fn watch_run(&self, request: Request<v1::WatchRunRequest>) -> Result<Response<Self::WatchRunStream>, Status> {
        self.client().watch_run(request.into_inner()).await
    }

    async fn checkpoint(
        &self,
        request: Request<v1::CheckpointRequest>,
    ) -> Result<Response<v1::CheckpointResponse>, Status> {
        self.client().checkpoint(request.into_inner()).await
    }

    async fn drain(&self, request: Request<v1::DrainRequest>) -> Result<Response<v1::DrainResponse>, Status> {
        self.client().drain(request.into_inner()).await
    }
}
