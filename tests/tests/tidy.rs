//! Rules of the repository that a compiler does not check.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::RunConfig;
use magex_core::task::{Spawn, TaskConfig, TaskName};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// Normal dependencies of each of our crates.
fn edges() -> BTreeMap<String, BTreeSet<String>> {
    let metadata = cargo_metadata::MetadataCommand::new()
        .manifest_path(root().join("Cargo.toml"))
        .no_deps()
        .other_options(["--offline".to_owned()])
        .exec()
        .unwrap();
    metadata
        .packages
        .iter()
        .map(|p| {
            let names = p
                .dependencies
                .iter()
                .filter(|d| d.kind == cargo_metadata::DependencyKind::Normal)
                .map(|d| d.name.clone())
                .collect();
            (p.name.to_string(), names)
        })
        .collect()
}

/// Everything a crate reaches through our crates.
fn reach(edges: &BTreeMap<String, BTreeSet<String>>, from: &str) -> BTreeSet<String> {
    let mut seen = BTreeSet::new();
    let mut open = vec![from.to_owned()];
    while let Some(name) = open.pop() {
        for next in edges.get(&name).into_iter().flatten() {
            if seen.insert(next.clone()) {
                open.push(next.clone());
            }
        }
    }
    seen
}

#[test]
fn dependencies_point_down_only() {
    let edges = edges();
    let services = ["magex-actor", "magex-learner", "magex-commander"];
    let never: [(&str, &[&str]); 12] = [
        ("magex-core", &["tokio", "tonic", "candle-core", "magex-env", "magex-nets", "magex-proto", "magex-runtime"]),
        ("magex-env", &["tokio", "tonic", "candle-core", "magex-nets", "magex-proto", "magex-runtime"]),
        ("magex-assign", &["tokio", "tonic", "candle-core", "magex-nets", "magex-proto", "magex-env"]),
        ("magex-dispatch", &["tokio", "candle-core", "magex-env", "magex-nets", "magex-runtime"]),
        ("magex-nets", &["tokio", "tonic", "magex-env", "magex-proto", "magex-runtime"]),
        ("magex-proto", &["candle-core", "magex-env", "magex-nets", "magex-runtime"]),
        ("magex-runtime", &["candle-core", "magex-core", "magex-env", "magex-nets", "magex-proto"]),
        ("magex-verify", &["tokio", "tonic", "candle-core", "magex-nets", "magex-proto", "magex-runtime"]),
        ("magex-viewer", &["candle-core", "magex-env", "magex-nets", "magex-learner"]),
        ("magex", &["magex-bench"]),
        ("magex-learner", &["magex-env"]),
        ("magex-commander", &["magex-env"]),
    ];
    for (name, forbidden) in never {
        let reached = reach(&edges, name);
        for bad in forbidden {
            assert!(!reached.contains(*bad), "{name} must not reach {bad}");
        }
    }
    for service in services {
        let reached = reach(&edges, service);
        for other in services.iter().filter(|o| **o != service) {
            assert!(!reached.contains(*other), "{service} must not reach {other}");
        }
    }
}

fn sources(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap().filter_map(Result::ok) {
        let path = entry.path();
        let name = entry.file_name().to_string_lossy().into_owned();
        if path.is_dir() {
            if !matches!(name.as_str(), "target" | ".git" | "runs" | "testdata") {
                sources(&path, out);
            }
        } else if name.ends_with(".rs") {
            out.push(path);
        }
    }
}

#[test]
fn what_is_there_in_two_versions_is_known() {
    let lock = std::fs::read_to_string(root().join("Cargo.lock")).unwrap();
    let mut versions = BTreeMap::<&str, usize>::new();
    for name in lock.lines().filter_map(|line| line.strip_prefix("name = ")) {
        *versions.entry(name.trim_matches('"')).or_default() += 1;
    }
    let twice: BTreeSet<&str> = versions.iter().filter(|(_, count)| **count > 1).map(|(name, _)| *name).collect();
    let text = std::fs::read_to_string(root().join("docs/dependencies.md")).unwrap();
    let rows = text.split("## In more than one version").nth(1).unwrap().lines().filter(|line| line.starts_with("| `"));
    let known: BTreeSet<&str> =
        rows.flat_map(|row| row.split('|').nth(1).unwrap_or("").split('`').skip(1).step_by(2)).collect();
    let (new, gone) = (twice.difference(&known), known.difference(&twice));
    let (new, gone): (Vec<_>, Vec<_>) = (new.collect(), gone.collect());
    assert!(
        new.is_empty() && gone.is_empty(),
        "docs/dependencies.md: in more than one version, not listed: {new:?}; listed, no longer so: {gone:?}"
    );
}

#[test]
fn files_stay_readable_and_mains_stay_short() {
    let mut files = Vec::new();
    sources(&root(), &mut files);
    assert!(files.len() > 50);
    for path in files {
        let text = std::fs::read_to_string(&path).unwrap();
        let lines = text.lines().count();
        let is_test = path.components().any(|c| c.as_os_str() == "tests") || path.ends_with("tests.rs");
        let product = text.split("#[cfg(test)]").next().unwrap_or("").lines().count();
        assert!(is_test || product <= 500, "{}: {product} lines; split it by meaning", path.display());
        if path.ends_with("main.rs") {
            assert!(lines < 100, "{}: {lines} lines; a main only wires", path.display());
        }
        assert!(path.file_name().unwrap() != "mod.rs", "{}: use name.rs beside name/", path.display());
    }
}

#[test]
fn every_configuration_key_and_dependency_is_documented() {
    let mut config = RunConfig::default().to_toml().unwrap();
    for name in [TaskName::PushBall, TaskName::Drones] {
        let task = TaskConfig::of(name, 4, Spawn::Uniform);
        let other = RunConfig { task, ..RunConfig::default() }.to_toml().unwrap();
        let own = other.split("\n\n").find(|section| section.starts_with("[task.")).unwrap();
        config = format!("{config}\n{own}\n");
    }
    let reference = std::fs::read_to_string(root().join("docs/configuration.md")).unwrap();
    let mut section = String::new();
    for line in config.lines() {
        if let Some(name) = line.strip_prefix('[') {
            section = name.trim_end_matches(']').to_owned();
        } else if let Some((key, value)) = line.split_once(" = ") {
            let row = reference
                .lines()
                .find(|l| l.starts_with(&format!("| `{section}.{key}` ")))
                .unwrap_or_else(|| panic!("docs/configuration.md does not list `{section}.{key}`"));
            let shown = row.split('|').nth(2).unwrap_or("").trim().trim_matches('`');
            let same = shown == value.trim_matches('"')
                || matches!((shown.parse::<f64>(), value.parse::<f64>()), (Ok(a), Ok(b)) if (a - b).abs() <= 1e-6 * b.abs());
            assert!(same, "docs/configuration.md gives `{section}.{key}` the default {shown}, the code {value}");
        }
    }
    for row in reference.lines().filter(|l| l.starts_with("| `") && l.contains('.')) {
        let name = row.split('`').nth(1).unwrap();
        let key = name.rsplit('.').next().unwrap();
        assert!(config.contains(&format!("{key} = ")), "docs/configuration.md lists {name}, which does not exist");
    }
    let dependencies = std::fs::read_to_string(root().join("docs/dependencies.md")).unwrap();
    let manifest = std::fs::read_to_string(root().join("Cargo.toml")).unwrap();
    for line in
        manifest.split("[workspace.dependencies]").nth(1).unwrap().split("[workspace.lints").next().unwrap().lines()
    {
        if let Some((name, _)) = line.split_once(" = ")
            && !name.starts_with("magex")
            && !name.starts_with('#')
        {
            assert!(dependencies.contains(&format!("`{name}`")), "docs/dependencies.md does not say why {name}");
        }
    }
}
