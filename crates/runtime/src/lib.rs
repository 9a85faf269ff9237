//! What every service needs and no domain type: logs, traces, metrics, shutdown, sockets, TLS, callers, servers, clients, health, retries.

pub mod access;
pub mod admission;
pub mod backoff;
pub mod calls;
pub mod client;
pub mod connections;
pub mod deadline;
pub mod door;
pub mod exit;
pub mod health;
pub mod http;
pub mod metrics;
pub mod process;
pub mod security;
pub mod server;
pub mod shutdown;
pub mod status;
pub mod sync;
pub mod telemetry;
pub mod tls;
pub mod trace;
