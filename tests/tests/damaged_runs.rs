//! Damaged run folders, the same ones every time: refused by name, or continued with the same numbers and whole lines, those that
//! are missing named. `fuzz/` has the same target with coverage.
#![allow(clippy::panic, clippy::print_stdout, reason = "counts of a long test, and the input that fails")]

use magex_core::rng::{Key, Purpose};
use magex_tests::decoders::run_folder::{RunFolder, Verdict};

/// Inputs of a few mutations each. Counts refusals, whole resumes, resumes with missing lines, and runs that begin again.
fn attack(count: u32) -> [u32; 4] {
    let folder = RunFolder::default();
    let mut counts = [0; 4];
    for number in 0..count {
        let mut stream = Key::new(23, Purpose::Bench, &[number]).stream();
        // A mutation takes six bytes.
        let length = 6 * (1 + stream.below(if number % 4 == 0 { 8 } else { 2 }));
        let bytes: Vec<u8> = (0..length).map(|_| stream.below(256) as u8).collect();
        let verdict = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| folder.attack(&bytes)));
        match verdict.unwrap_or_else(|_| panic!("input {number}: {bytes:?}")) {
            Verdict::Refused(_) => counts[0] += 1,
            Verdict::Resumed(_, 0) => counts[1] += 1,
            Verdict::Resumed(..) => counts[2] += 1,
            Verdict::Anew => counts[3] += 1,
        }
    }
    counts
}

#[test]
fn a_damaged_folder_is_refused_by_name_or_continues_with_the_same_numbers_and_whole_lines() {
    let [refused, whole, missing, _] = attack(400);
    assert!(
        refused > 10 && whole > 100 && missing > 10,
        "{refused} refused, {whole} whole, {missing} with missing lines"
    );
}

#[test]
#[ignore = "takes minutes; .ci/long"]
fn ten_thousand_damaged_folders() {
    let [refused, whole, missing, anew] = attack(10_000);
    println!(
        "{refused} refused, {whole} continued whole, {missing} with lines that were named as missing, {anew} begun again"
    );
}
