//! What people look at: the live page of a run, its learning curves and replays of its episodes.
//!
//! | module | content |
//! |---|---|
//! | [`page`] | the live page: one HTML file without external assets, and the JSON that its script requests |
//! | [`replay`] | recorded episodes as one self-contained HTML file |
//! | [`pictures`] | the pictures of an environment that draws itself, as one self-contained HTML file |
//! | [`scene`] | how an episode is packed and drawn, shared by the live page and the replays |
//! | [`curve`] | `curve.svg`: the curves over joint steps as a picture |
//!
//! Nothing here knows the trainer: callers pass plain data ([`page::RunEnd`], lines of `metrics.jsonl`, recordings).

pub mod curve;
pub mod page;
pub mod pictures;
mod plots;
pub mod replay;
pub mod scene;
