//! What a call's headers say.

use std::time::Duration;
use tonic::metadata::MetadataMap;

/// The call's own deadline.
pub(crate) fn deadline(metadata: &MetadataMap) -> Option<Duration> {
    magex_runtime::net::deadline::requested(metadata.get("grpc-timeout")?.to_str().ok()?)
}
