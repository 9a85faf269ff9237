//! The wire and nothing else: messages, services, and the conversions between them and the domain types.
//!
//! Arrays travel as little-endian bytes. Results and weights are cut into parts, far below [`MAX_MESSAGE_BYTES`].

pub mod apart;
pub mod arrays;
pub mod codec;
pub mod convert;
pub mod elements;
pub mod goals;
pub mod parts;
pub mod weights;
pub mod weights_watch;

/// Generated from `proto/magex/v1`.
#[allow(missing_docs, unreachable_pub, clippy::all)]
pub mod v1 {
    tonic::include_proto!("magex.v1");
    include!(concat!(env!("OUT_DIR"), "/sent.rs"));
}

/// Bytes that a message takes on the wire.
pub fn encoded_len(message: &impl prost::Message) -> usize {
    message.encoded_len()
}

/// The services of this program on the wire, and their names for people.
pub const SERVICES: [(&str, &str); 3] = [
    (v1::learner_service_server::SERVICE_NAME, LEARNER),
    (v1::commander_service_server::SERVICE_NAME, COMMANDER),
    (v1::policy_service_server::SERVICE_NAME, COMMANDER),
];

/// The learner's name for people.
pub const LEARNER: &str = "learner";

/// The commander's name for people.
pub const COMMANDER: &str = "commander";

/// Version of the protocol that this build speaks; both sides of a handshake must agree on it.
pub const PROTOCOL_VERSION: u32 = 4;

/// Longest message that any side decodes, bytes.
pub const MAX_MESSAGE_BYTES: usize = 2 << 20;

/// Longest message between actors and commander, bytes: the positions of a shard's episodes travel whole.
pub const MAX_BATCH_BYTES: usize = 32 << 20;

/// Longest payload of a part, bytes: with its envelope it stays within a mebibyte.
pub const PART_BYTES: usize = (1 << 20) - 4096;

/// Descriptors of all files, encoded, for server reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/magex_descriptor.bin"));
