//! The goal commander as a service: for the actors of a run, and for anybody who has agents and goals.
mod answering;
mod api;
mod batch;
mod classical;
pub mod cli;
mod gauges;
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
