//! The goal commander as a service: for the actors of a run, and for anybody who has agents and goals.
pub mod access;
mod admission;
mod answering;
mod api;
mod classical;
pub mod cli;
mod keeper;
pub mod learned;
mod metadata;
pub mod scheduler;
pub mod service;
mod store;
mod streams;
mod subscription;
pub mod trained;
mod training;
pub mod weights_file;
