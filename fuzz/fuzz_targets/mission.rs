//! A mission and its updates. See fuzz/run.
#![no_main]

use magex_tests::decoders::dispatch;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dispatch::mission(bytes));
