//! magex-commander
pub mod learned;
mod assign;
mod classical;
pub mod scheduler;
pub mod service;
mod store;
mod subscription;
pub mod cli;
pub mod trained;
