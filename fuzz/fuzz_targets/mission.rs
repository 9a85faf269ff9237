//! A mission and its updates. See fuzz/run.
#![no_main]

#[path = "../../tests/src/decoders/dispatch.rs"]
#[allow(dead_code)]
mod dispatch;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| dispatch::mission(bytes));
