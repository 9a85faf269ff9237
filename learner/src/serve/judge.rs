//! The learner's own host computes a shard, if there is no other way to find out which result of it is right.

use crate::origin::Origin;
use magex_core::ids::{RunId, Shard};
use magex_core::trajectory::ShardResult;
use magex_proto::convert::encode_result;
use magex_proto::weights::Weights;

/// Computes a shard from the weights that it names. The learner links no physics, so its caller provides it.
pub type Compute = Box<dyn FnMut(&Shard, &Weights) -> Result<ShardResult, String> + Send>;

/// What computes shards on this host, if anything does.
#[derive(Default)]
pub struct Judge(Option<Compute>);

impl std::fmt::Debug for Judge {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Judge").field(&self.0.is_some()).finish()
    }
}

impl Judge {
    /// One that computes shards.
    pub fn new(compute: Compute) -> Self {
        Self(Some(compute))
    }

    /// The digest of a shard's right result, as [`Origin::digest`] has it.
    pub(crate) fn digest(&mut self, run: &RunId, shard: &Shard, weights: &Weights) -> Result<String, String> {
        let compute = self.0.as_mut().ok_or("this learner cannot compute shards")?;
        let result = compute(shard, weights)?;
        Ok(Origin::digest_of(&encode_result(run, &weights.sha256, &result)))
    }
}
