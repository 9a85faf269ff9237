//! A weights file, up to the scheduler that it makes. See fuzz/run.
#![no_main]

use magex_tests::decoders::files::Run;
use std::sync::LazyLock;

static RUN: LazyLock<Run> = LazyLock::new(Run::default);

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| RUN.weights(bytes));
