//! The record of a mission on disk. See fuzz/run.
#![no_main]

use magex_tests::decoders::dispatch;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dispatch::record(bytes));
