//! The result of a shard, up to what the learner trains on. See fuzz/run.
#![no_main]

use magex_tests::decoders::files::Run;
use std::sync::LazyLock;

static RUN: LazyLock<Run> = LazyLock::new(Run::default);

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| RUN.admit(bytes));
