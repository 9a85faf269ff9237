//! magex-commander
mod assign;
mod classical;
pub mod cli;
pub mod learned;
pub mod scheduler;
pub mod service;
mod store;
mod subscription;
pub mod trained;
