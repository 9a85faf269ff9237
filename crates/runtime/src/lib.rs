//! What every service shares and no domain type: the path of a call ([`net`]), servers, clients, TLS, health and retries; logs,
//! traces and metrics; the start and the end of a process ([`service`]).

pub mod backoff;
pub mod client;
pub mod exit;
pub mod health;
pub mod http;
pub mod limits;
pub mod log_line;
pub mod metrics;
pub mod net;
pub mod options;
pub mod peer;
pub mod process;
pub mod reload;
pub mod security;
pub mod server;
pub mod service;
pub mod shutdown;
pub mod status;
pub mod sync;
pub mod telemetry;
pub mod tls;
pub mod trace;

use std::future::Future;
use std::pin::Pin;

/// A future whose code is compiled in this crate. The body of an `async fn` is compiled again in every crate that awaits it,
/// and here it brings a whole HTTP/2 stack along.
pub type Boxed<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;
