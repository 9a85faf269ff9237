//! Exit codes, as in sysexits.h.

/// Everything went well.
pub const OK: u8 = 0;
/// The work failed.
pub const FAILURE: u8 = 1;
/// Wrong usage or configuration: nothing was started.
pub const USAGE: u8 = 64;
/// A service that is needed cannot be used.
pub const UNAVAILABLE: u8 = 69;
/// A fault of ours.
pub const INTERNAL: u8 = 70;
/// An output cannot be created.
pub const CANNOT_CREATE: u8 = 73;
/// Stopped before the end; resuming continues.
pub const TEMPORARY: u8 = 75;
/// Interrupted twice.
pub const INTERRUPTED: u8 = 130;
