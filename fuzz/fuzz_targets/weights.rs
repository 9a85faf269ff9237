//! A stream of weights. See fuzz/run.
#![no_main]

#[path = "../../tests/src/decoders/wire.rs"]
#[allow(dead_code)]
mod wire;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| wire::weights(bytes));
