//! Which actor computed a result, and what follows if it is wrong.

use magex_core::ids::Shard;
use magex_core::sha256;
use std::sync::Arc;

/// Where a result comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origin {
    /// Name of the actor, for people.
    pub actor: Arc<str>,
    /// Id of the actor's process.
    pub process: u64,
    /// SHA-256 (hex) of the encoded result.
    pub digest: String,
}

impl Origin {
    /// The digest of an encoded result.
    pub fn digest_of(encoded: &[u8]) -> String {
        sha256::hex(encoded)
    }
}

/// An actor is proven to have sent a wrong result: what it computed before cannot be relied on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Conviction {
    /// The sender, and the digest of its wrong result.
    pub origin: Origin,
    /// The shard of that result.
    pub shard: Shard,
    /// SHA-256 (hex) of the right result.
    pub digest: String,
    /// First iteration that trained on results of this sender which no second computation has confirmed, if there is one.
    pub since: Option<u32>,
}
