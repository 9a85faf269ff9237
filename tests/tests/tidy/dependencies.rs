//! What a crate may link, and that it uses what it declares.

use crate::rust::{code_only, identifiers, product_code};
use crate::workspace::{files, folder, metadata, product_files, read, root};
use cargo_metadata::{DependencyKind, Metadata, PackageId};
use std::collections::{BTreeMap, BTreeSet};

/// Names of all packages that `name` links, over any number of edges, third-party packages included.
fn reach(metadata: &Metadata, name: &str) -> BTreeSet<String> {
    let nodes: BTreeMap<&PackageId, _> =
        metadata.resolve.as_ref().unwrap().nodes.iter().map(|node| (&node.id, node)).collect();
    let start = metadata.packages.iter().find(|package| package.name.as_str() == name);
    let mut seen = BTreeSet::new();
    let mut open = vec![&start.unwrap_or_else(|| panic!("no package {name}")).id];
    while let Some(id) = open.pop() {
        for next in &nodes[id].deps {
            let linked = next.dep_kinds.iter().any(|kind| kind.kind == DependencyKind::Normal);
            if linked && seen.insert(&next.pkg) {
                open.push(&next.pkg);
            }
        }
    }
    let names = metadata.packages.iter().filter(|package| seen.contains(&package.id));
    names.map(|package| package.name.to_string()).collect()
}

#[test]
fn dependencies_point_down_only() {
    let metadata = metadata();
    let services = ["magex-actor", "magex-learner", "magex-commander"];
    let network = ["tokio", "tonic", "hyper"];
    let tensors = ["candle-core", "candle-nn"];
    // (crate, packages that it must not link on any way)
    let never: [(&str, &[&str]); 14] = [
        ("magex-core", &["magex-assign", "magex-env", "magex-nets", "magex-proto", "magex-runtime", "rapier3d"]),
        ("magex-assign", &["magex-env", "magex-nets", "magex-proto", "magex-runtime", "rapier3d"]),
        ("magex-env", &["magex-nets", "magex-proto", "magex-runtime"]),
        ("magex-nets", &["magex-env", "magex-proto", "magex-runtime", "rapier3d"]),
        ("magex-policy", &["magex-env", "magex-proto", "magex-runtime", "rapier3d"]),
        ("magex-proto", &["magex-env", "magex-nets", "magex-runtime", "rapier3d"]),
        ("magex-dispatch", &["magex-env", "magex-nets", "magex-runtime", "rapier3d"]),
        ("magex-runtime", &["magex-core", "magex-env", "magex-nets", "magex-proto", "rapier3d"]),
        ("magex-viewer", &["magex-assign", "magex-env", "magex-nets", "magex-learner", "rapier3d"]),
        ("magex-verify", &["magex-nets", "magex-proto", "magex-runtime"]),
        ("magex-stats", &["magex-env", "magex-nets", "magex-proto", "magex-runtime", "rapier3d"]),
        ("magex", &["magex-bench"]),
        ("magex-learner", &["magex-env", "rapier3d"]),
        ("magex-commander", &["magex-env", "rapier3d"]),
    ];
    // Missions and costs are messages, so `dispatch` links the wire and with it a runtime; it must not use one.
    let without_network =
        ["magex-core", "magex-assign", "magex-env", "magex-nets", "magex-policy", "magex-verify", "magex-stats"];
    let without_tensors = [
        "magex-core",
        "magex-assign",
        "magex-env",
        "magex-proto",
        "magex-dispatch",
        "magex-runtime",
        "magex-viewer",
        "magex-verify",
        "magex-stats",
    ];
    let mut rules: Vec<(&str, &str)> = never.iter().flat_map(|(name, bad)| bad.iter().map(|b| (*name, *b))).collect();
    rules.extend(without_network.iter().flat_map(|name| network.map(|bad| (*name, bad))));
    rules.extend(without_tensors.iter().flat_map(|name| tensors.map(|bad| (*name, bad))));
    rules.extend(services.iter().flat_map(|a| services.map(|b| (*a, b))).filter(|(a, b)| a != b));
    let mut reached = BTreeMap::new();
    for (name, bad) in rules {
        let reached = reached.entry(name).or_insert_with(|| reach(&metadata, name));
        assert!(!reached.contains(bad), "{name} must not link {bad}");
    }
    for package in metadata.workspace_packages() {
        let direct =
            |bad: &&str| package.dependencies.iter().any(|d| d.name == *bad && d.kind == DependencyKind::Normal);
        if package.name.as_str() == "magex-dispatch" {
            assert_eq!(["tokio", "tonic", "tokio-util"].iter().find(|bad| direct(bad)), None, "{}", package.name);
        }
        let may_load = ["magex-bench", "magex-tests"].contains(&package.name.as_str());
        assert!(
            may_load || !direct(&"magex-bench"),
            "{} is product and must not link the load generators",
            package.name
        );
    }
}

/// Dependencies that a crate needs without naming them in its sources.
const USED_WITHOUT_A_NAME: [(&str, &str, &str); 3] = [
    ("magex-proto", "prost", "generated code"),
    ("magex-proto", "tonic-prost", "generated code"),
    ("magex-proto", "bytes", "generated code"),
];

#[test]
fn every_declared_dependency_is_used() {
    let metadata = metadata();
    let mut unused = Vec::new();
    for package in metadata.workspace_packages() {
        let words = |text: &str| identifiers(text).map(str::to_owned).collect::<Vec<_>>();
        let product = product_files(package);
        let product: BTreeSet<String> =
            product.iter().flat_map(|file| words(&product_code(&std::fs::read_to_string(file).unwrap()))).collect();
        let own = files(&[".rs"]).into_iter().filter(|file| file.starts_with(folder(package)));
        let all: BTreeSet<String> =
            own.flat_map(|file| words(&code_only(&std::fs::read_to_string(root().join(file)).unwrap()))).collect();
        for dependency in &package.dependencies {
            let name = dependency.rename.as_ref().unwrap_or(&dependency.name).replace('-', "_");
            let seen = if dependency.kind == DependencyKind::Normal { &product } else { &all };
            let excused =
                |(at, what, _): &&(&str, &str, &str)| *at == package.name.as_str() && *what == dependency.name;
            if !seen.contains(&name) && !USED_WITHOUT_A_NAME.iter().any(|entry| excused(&entry)) {
                unused.push(format!("{} ({}): {}", package.name, dependency.kind, dependency.name));
            }
        }
    }
    assert!(unused.is_empty(), "declared in a manifest and used nowhere; delete the lines:\n{}", unused.join("\n"));
}

#[test]
fn packages_in_two_versions_are_documented() {
    let lock = read("Cargo.lock");
    let mut versions = BTreeMap::<&str, usize>::new();
    for name in lock.lines().filter_map(|line| line.strip_prefix("name = ")) {
        *versions.entry(name.trim_matches('"')).or_default() += 1;
    }
    let twice: BTreeSet<&str> = versions.iter().filter(|(_, count)| **count > 1).map(|(name, _)| *name).collect();
    let text = read("docs/dependencies.md");
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
