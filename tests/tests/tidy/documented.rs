//! Keys and dependencies are documented, with the defaults that the code has.

use crate::workspace::{files, read};
use magex_core::config::{MappoConfig, RunConfig, RunSection};
use magex_core::task::{Spawn, TaskConfig, TaskName};

/// Every configuration key with its default, as TOML: the default run, and the sections of the other tasks.
pub(crate) fn configuration() -> String {
    // The tables tell the defaults of a file with a task, not those of the first run.
    let plain = RunConfig { run: RunSection::default(), mappo: MappoConfig::default(), ..RunConfig::default() };
    let mut config = plain.to_toml().unwrap();
    for name in TaskName::ALL.into_iter().filter(|&name| name != RunConfig::default().task.name) {
        let task = TaskConfig::of(name, 4, Spawn::Uniform);
        let other = RunConfig { task, ..RunConfig::default() }.to_toml().unwrap();
        let own = other.split("\n\n").find(|section| section.starts_with("[task.")).unwrap();
        config = format!("{config}\n{own}\n");
    }
    config
}

#[test]
fn every_configuration_key_and_dependency_is_documented() {
    let config = configuration();
    let reference = read("docs/configuration.md");
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
    let dependencies = read("docs/dependencies.md");
    let manifest = read("Cargo.toml");
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

/// What an operator searches logs for is there to be found.
#[test]
fn messages_that_the_failure_table_quotes_exist() {
    let product = files(&[".rs"]).into_iter().filter(|file| !file.starts_with("tests"));
    let sources: String = product.map(|file| read(&file.to_string_lossy())).collect();
    let page = read("docs/operations.md");
    let (_, table) = page.split_once("## Failure by failure").unwrap();
    let table = table.split("\n## ").next().unwrap();
    for row in table.lines().filter(|line| line.starts_with("| ")).skip(1) {
        let symptom = row.split(" | ").nth(1).unwrap_or_default();
        for quoted in symptom.split('`').skip(1).step_by(2) {
            // A metric is declared without the `magex_<service>_` of its name. N stands for a number.
            let metric = quoted.strip_prefix("magex_").and_then(|name| name.split_once('_'));
            let found = match metric {
                Some((_, name)) => sources.contains(&format!("\"{name}\"")),
                None => quoted.split(" N ").all(|piece| sources.contains(piece)),
            };
            assert!(found, "docs/operations.md quotes a message that no program writes: {quoted}");
        }
    }
}
