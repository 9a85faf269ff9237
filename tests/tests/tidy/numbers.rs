//! What decides a number reads no clock and iterates over no hash map: only configuration and seed reach a number.

use crate::rust::{identifiers, product_code};
use crate::workspace::{metadata, product_files, root};
use std::path::Path;

/// Crates in which every line may decide a number.
const CRATES: [&str; 5] = ["magex-core", "magex-env", "magex-assign", "magex-nets", "magex-stats"];
/// The part of the learner that does.
const FOLDERS: [&str; 1] = ["learner/src/train"];
/// Clocks, and collections whose order is another in every process.
const BANNED: [&str; 6] = ["Instant", "SystemTime", "HashMap", "HashSet", "RandomState", "available_parallelism"];
/// (folder or file, word, reason)
const EXEMPT: [(&str, &str, &str); 1] = [(
    "crates/nets/src/params",
    "HashMap",
    "safetensors takes its metadata in one; ours has one entry, which has only one order",
)];

#[test]
fn nothing_but_configuration_and_seed_can_reach_a_number() {
    let metadata = metadata();
    let mut found = Vec::new();
    let mut count = 0;
    for package in metadata.workspace_packages() {
        for file in product_files(package) {
            let path = file.strip_prefix(root()).unwrap();
            let numeric = CRATES.contains(&package.name.as_str()) || FOLDERS.iter().any(|at| path.starts_with(at));
            // Measuring programs need a clock; they decide nothing.
            if !numeric || path.ends_with("bench.rs") {
                continue;
            }
            count += 1;
            let exempt = |word: &str| EXEMPT.iter().any(|(at, what, _)| *what == word && below(path, at));
            let code = product_code(&std::fs::read_to_string(&file).unwrap());
            let words = identifiers(&code).filter(|word| BANNED.contains(word) && !exempt(word));
            found.extend(words.map(|word| format!("{}: {word}", path.display())));
        }
    }
    assert!(count > 60, "only {count} files were read");
    assert!(found.is_empty(), "clocks and unordered collections have no place here:\n{}", found.join("\n"));
}

/// Whether a path is the module `at` or below it.
fn below(path: &Path, at: &str) -> bool {
    path.starts_with(at) || path.with_extension("") == Path::new(at)
}
