//! Sizes of files, the size of the whole, and cycles between modules.

use crate::cycles::cycles;
use crate::rust::product_lines;
use crate::workspace::{files, folder, metadata, product_files, root, targets};
use std::collections::BTreeSet;
use std::path::PathBuf;

/// What a file of the product may have at most, in lines; 300 are wanted.
const FILE_LINES: usize = 500;
/// What the whole product may have at most, in lines of Rust with comments and blank lines.
const PRODUCT_LINES: usize = 61_500;
/// Cycles that stay: crate, a module of the cycle, reason. At most one in the workspace.
const ALLOWED_CYCLES: [(&str, &str, &str); 0] = [];

/// Whether a file belongs to the measuring programs, which are not product.
fn bench(file: &std::path::Path) -> bool {
    file.components().any(|part| part.as_os_str() == "bench" || part.as_os_str() == "bench.rs")
}

#[test]
fn files_stay_readable_and_mains_stay_short() {
    let metadata = metadata();
    let product: BTreeSet<PathBuf> =
        metadata.workspace_packages().iter().flat_map(|package| product_files(package)).collect();
    assert!(product.len() > 150, "only {} files of the product were found", product.len());
    for path in &product {
        let text = std::fs::read_to_string(path).unwrap();
        let lines = product_lines(&text);
        assert!(lines <= FILE_LINES, "{}: {lines} lines; split it by meaning", path.display());
        if path.ends_with("main.rs") {
            let lines = text.lines().count();
            assert!(lines < 100, "{}: {lines} lines; a main only wires", path.display());
        }
    }
    for path in files(&["mod.rs"]) {
        assert!(path.file_name().unwrap() != "mod.rs", "{}: use name.rs beside name/", path.display());
    }
    let known: BTreeSet<PathBuf> = metadata
        .workspace_packages()
        .iter()
        .flat_map(|package| targets(package))
        .flat_map(|modules| modules.product.into_values().chain(modules.tests))
        .collect();
    for path in files(&[".rs"]) {
        let in_source = path.components().any(|part| part.as_os_str() == "src");
        assert!(!in_source || known.contains(&root().join(&path)), "{}: no module declares it", path.display());
    }
}

#[test]
fn the_product_stays_small() {
    let metadata = metadata();
    let mut total = 0;
    for package in metadata.workspace_packages() {
        let folder = folder(package);
        if folder.starts_with("tests") || folder.starts_with("examples") {
            continue;
        }
        let files: Vec<PathBuf> = product_files(package).into_iter().filter(|file| !bench(file)).collect();
        let lines: usize = files.iter().map(|file| product_lines(&std::fs::read_to_string(file).unwrap())).sum();
        println!("{lines:>6} lines in {:>3} files: {}", files.len(), folder.display());
        total += lines;
    }
    println!("{total:>6} lines of Rust outside tests, bench, fuzz and examples; the limit is {PRODUCT_LINES}");
    assert!(total <= PRODUCT_LINES, "{total} lines of Rust: delete before adding");
}

/// `cargo test -p magex-tests --test tidy -- module_cycles --nocapture` prints them.
#[test]
fn module_cycles() {
    let metadata = metadata();
    let mut bad = Vec::new();
    let mut count = 0;
    for package in metadata.workspace_packages() {
        for group in targets(package).iter().flat_map(cycles) {
            let group: Vec<String> = group.into_iter().collect();
            let allowed = ALLOWED_CYCLES
                .iter()
                .find(|(at, one, _)| *at == package.name.as_str() && group.contains(&(*one).to_owned()));
            let reason = allowed.map_or("not allowed", |(_, _, reason)| *reason);
            println!("{}: {} modules, {reason}: {}", package.name, group.len(), group.join(", "));
            count += 1;
            if allowed.is_none() {
                bad.push(format!("{}: {}", package.name, group.join(", ")));
            }
        }
    }
    println!("{count} cycles between modules");
    assert!(ALLOWED_CYCLES.len() <= 1);
    assert!(bad.is_empty(), "these modules use each other in a circle; move what they share:\n{}", bad.join("\n"));
}
