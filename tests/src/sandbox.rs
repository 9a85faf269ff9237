//! A cluster of real processes.
