//! What is in `deploy/` speaks of the programs as they are. No engine, no cluster: names and files only.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::RunConfig;
use magex_tests::sandbox::binary;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn deploy() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("deploy")
}

fn read(name: &str) -> String {
    let path = deploy().join(name);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Names of this form in a text.
fn names<'a>(text: &'a str, prefix: &str, part: fn(char) -> bool) -> BTreeSet<&'a str> {
    let all = text.match_indices(prefix).map(|(start, _)| {
        let rest = &text[start..];
        let end = rest.find(|c: char| !part(c)).unwrap_or(rest.len());
        &rest[..end]
    });
    all.collect()
}

fn is_variable(c: char) -> bool {
    c.is_ascii_uppercase() || c == '_'
}

#[test]
fn every_variable_is_one_that_a_program_reads() {
    let help: String = ["learner", "actor", "commander"]
        .map(|role| {
            let output = Command::new(binary()).args([role, "--help"]).output().unwrap();
            String::from_utf8(output.stdout).unwrap()
        })
        .concat();
    let known = names(&help, "MAGEX_", is_variable);
    assert!(known.len() > 15, "{known:?}");
    for file in [
        "compose.yaml",
        "compose.tls.yaml",
        "compose.environment.yaml",
        "k8s/base/learner.yaml",
        "k8s/base/commander.yaml",
        "k8s/base/actor.yaml",
    ] {
        let text = read(file);
        // In compose files: what is set, not what is filled in from .env.
        let set = text.lines().filter_map(|line| {
            let line = line.trim();
            let name = line.strip_prefix("- { name: ").or_else(|| line.strip_prefix("- name: ")).unwrap_or(line);
            let end = name.find(|c: char| !is_variable(c)).unwrap_or(name.len());
            name.starts_with("MAGEX_").then(|| name[..end].to_owned())
        });
        for name in set {
            assert!(known.contains(name.as_str()), "deploy/{file} sets {name}, which no program reads");
        }
    }
}

#[test]
fn every_setting_of_the_compose_files_has_a_default() {
    let defaults = read(".env");
    for file in ["compose.yaml", "compose.tls.yaml", "compose.environment.yaml"] {
        let text = read(file);
        for (start, _) in text.match_indices("${") {
            let name = text[start + 2..].split('}').next().unwrap();
            let line = format!("{name}=");
            assert!(defaults.lines().any(|l| l.starts_with(&line)), "deploy/{file}: {name} is not in deploy/.env");
        }
    }
}

#[test]
fn every_configuration_can_be_run() {
    let mut files = vec![deploy().join("k8s/base/run.toml"), deploy().join("k8s/overlays/example/run.toml")];
    for folder in ["configs", "configs/baselines"] {
        let entries = fs::read_dir(deploy().join(folder)).unwrap().map(|entry| entry.unwrap().path());
        files.extend(entries.filter(|path| path.is_file()));
    }
    assert!(files.len() > 20);
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        RunConfig::from_toml(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        // A baseline says where its settings are explained.
        if let Some(page) = text.lines().find_map(|line| line.strip_prefix("# docs/")) {
            assert!(deploy().parent().unwrap().join("docs").join(page).is_file(), "{}: {page}", file.display());
        }
    }
}

#[test]
fn every_manifest_is_part_of_the_base() {
    let kustomization = read("k8s/base/kustomization.yaml");
    for entry in fs::read_dir(deploy().join("k8s/base")).unwrap() {
        let name = entry.unwrap().file_name().to_string_lossy().into_owned();
        let listed = kustomization.contains(&format!("- {name}\n")) || kustomization.contains(&format!("[{name}]"));
        assert!(listed || name == "kustomization.yaml", "deploy/k8s/base/{name} is in no list of kustomization.yaml");
    }
}

#[test]
fn dashboards_and_alerts_show_metrics_that_exist() {
    let catalogue = fs::read_to_string(deploy().parent().unwrap().join("docs/metrics.md")).unwrap();
    let is_metric = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    let dashboard = read("observe/grafana/dashboards/magex.json");
    let parsed: serde_json::Value = serde_json::from_str(&dashboard).unwrap();
    let panels = parsed["panels"].as_array().unwrap();
    assert!(panels.len() > 8);
    for panel in panels.iter().filter(|panel| panel["type"] != "row") {
        let targets = panel["targets"].as_array().unwrap();
        assert!(!targets.is_empty(), "{}: shows nothing", panel["title"]);
        assert!(targets.iter().all(|target| target["expr"].is_string()), "{}", panel["title"]);
    }
    let alerts = read("observe/alerts.yaml");
    for text in [&dashboard, &alerts] {
        let used = names(text, "magex_", is_metric);
        assert!(!used.is_empty());
        for name in used {
            // A histogram is listed once, and scraped under three names.
            let plain = ["_bucket", "_sum", "_count"].iter().find_map(|end| name.strip_suffix(end)).unwrap_or(name);
            let listed = [name, plain].iter().any(|name| catalogue.contains(&format!("`{name}`")));
            assert!(listed, "docs/metrics.md does not list {name}");
        }
    }
}
