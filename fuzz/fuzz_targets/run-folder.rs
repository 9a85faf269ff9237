//! The folder of a run, damaged by mutations that know what is in it. See fuzz/run.
#![no_main]

use magex_tests::decoders::run_folder::RunFolder;
use std::sync::LazyLock;

static RUN: LazyLock<RunFolder> = LazyLock::new(RunFolder::default);

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drop(RUN.attack(bytes)));
