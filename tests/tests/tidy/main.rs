//! Rules of the repository that a compiler does not check. Every rule reads the tree as it is: none names a file that it
//! expects, apart from the documents that it compares with the code.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

mod cycles;
mod dependencies;
mod documented;
mod glossary;
mod layout;
mod numbers;
mod prose;
mod rust;
mod workspace;
