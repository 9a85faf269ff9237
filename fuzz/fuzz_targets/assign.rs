//! A request, up to its answer. See fuzz/run.
#![no_main]

use magex_tests::decoders::dispatch;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dispatch::assign(bytes));
