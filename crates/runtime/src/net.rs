//! The path of a connection and of a call, from the socket to the handler.
//!
//! ```text
//!  listener
//!     │ accept                                                          [connections]
//!     │   total and per-peer limit; at the limit the connection that has waited longest is evicted
//!     │   no call within `first_call`, handshakes included: the connection is closed
//!     ▼
//!  TLS and HTTP/2 (tonic)
//!     ▼
//!  Guard                from the headers alone                          [guard]
//!     │   Guarded: calls and seconds are counted by method and code     [call_metrics]
//!     │   Guarded: authenticate by token or certificate                 [auth]
//!     │            mark the connection as `Called`: it is no longer evicted
//!     │   Public:  (health, reflection) the caller is its address; the connection is `Probed`
//!     │   both:    take a `Permit`: calls or streams of the caller      [in_flight]
//!     │            `grpc-timeout` becomes a `Deadline`                  [deadline]
//!     │   body:    the length of every message is counted before the message is read; compressed ones are unpacked [compression]
//!     ▼
//!  decoding, then the handler: `auth::caller` checks the role
//!     │
//!     ▼
//!  response             status texts are cut to what clients accept; the permit is released with the last frame
//! ```
//!
//! Codes: UNAUTHENTICATED for unknown credentials, RESOURCE_EXHAUSTED with a retry delay for a limit, UNAVAILABLE while the
//! service drains, DEADLINE_EXCEEDED for a deadline or a message that does not arrive, PERMISSION_DENIED for a role.

pub mod auth;
pub mod call_metrics;
mod compression;
pub mod connections;
pub mod deadline;
pub mod guard;
pub mod heartbeat;
pub mod in_flight;
pub mod socket;
