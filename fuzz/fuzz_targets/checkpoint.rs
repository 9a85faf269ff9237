//! A file of a checkpoint, whose manifest agrees with it or does not. See fuzz/run.
#![no_main]

use magex_tests::decoders::files::Run;
use std::sync::LazyLock;

static RUN: LazyLock<Run> = LazyLock::new(Run::default);

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| RUN.checkpoint(bytes));
