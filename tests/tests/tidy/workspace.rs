//! The workspace: its crates, their files, and what is tracked.

use crate::rust::{Modules, modules};
use cargo_metadata::{Metadata, MetadataCommand, Package};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The repository's folder.
pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// The text of a file of the repository.
pub(crate) fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Packages and the graph of everything that this machine would build, third-party packages included.
pub(crate) fn metadata() -> Metadata {
    let version = Command::new("rustc").arg("-vV").output().unwrap();
    let version = String::from_utf8(version.stdout).unwrap();
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).unwrap();
    MetadataCommand::new()
        .manifest_path(root().join("Cargo.toml"))
        .other_options(["--offline", "--locked", "--filter-platform", host].map(str::to_owned))
        .exec()
        .unwrap()
}

/// A package's folder, relative to the repository.
pub(crate) fn folder(package: &Package) -> PathBuf {
    let folder = package.manifest_path.parent().unwrap().as_std_path();
    folder.strip_prefix(root()).unwrap().to_owned()
}

/// The modules of each library, binary and build script of a package.
pub(crate) fn targets(package: &Package) -> Vec<Modules> {
    let kinds = |target: &&cargo_metadata::Target| target.is_lib() || target.is_bin() || target.is_custom_build();
    package.targets.iter().filter(kinds).map(|target| modules(target.src_path.as_std_path())).collect()
}

/// Files that a package's library, binaries and build script are made of, tests left out.
pub(crate) fn product_files(package: &Package) -> BTreeSet<PathBuf> {
    targets(package).into_iter().flat_map(|modules| modules.product.into_values()).collect()
}

/// Files of the repository with one of these endings, relative to its folder; build outputs and runs left out.
pub(crate) fn files(endings: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![root()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(&folder).unwrap().filter_map(Result::ok) {
            let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
            if path.is_dir() {
                if !matches!(name.as_str(), "target" | ".git" | "runs" | "testdata" | "corpus" | "artifacts") {
                    open.push(path);
                }
            } else if endings.iter().any(|ending| name.ends_with(ending)) {
                found.push(path.strip_prefix(root()).unwrap().to_owned());
            }
        }
    }
    found.sort();
    found
}
