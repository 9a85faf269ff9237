//! What every service needs and no domain type: logs, shutdown, sockets, TLS, servers, clients, health, retries.

pub mod backoff;
pub mod client;
pub mod exit;
pub mod health;
pub mod process;
pub mod server;
pub mod shutdown;
pub mod status;
pub mod telemetry;
pub mod tls;
