//! Byte strings in parts. See fuzz/run.
#![no_main]

use magex_tests::decoders::wire;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| wire::parts(bytes));
