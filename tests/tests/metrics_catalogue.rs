//! What the services show at /metrics is what docs/metrics.md lists, name by name, and the books balance.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::ExecutorKind;
use magex_tests::sandbox::{Cluster, options, wait_until};
use magex_tests::{small, train};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;

/// A metric: its type, and its labels.
type Entry = (String, BTreeSet<String>);
type Catalogue = BTreeMap<String, Entry>;

fn get(address: &str, path: &str) -> String {
    let mut socket = TcpStream::connect(address).unwrap();
    socket.write_all(format!("GET {path} HTTP/1.0\r\n\r\n").as_bytes()).unwrap();
    let mut answer = String::new();
    socket.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.0 200"), "{answer}");
    answer
}

fn scraped(text: &str) -> Catalogue {
    let mut found = Catalogue::new();
    for line in text.lines() {
        if let Some((name, kind)) = line.strip_prefix("# TYPE ").and_then(|rest| rest.split_once(' ')) {
            found.insert(name.to_owned(), (kind.to_owned(), BTreeSet::new()));
        } else if let Some((name, rest)) = line.split_once('{') {
            let base = ["_bucket", "_sum", "_count"].iter().find_map(|end| {
                let base = name.strip_suffix(end)?;
                found.contains_key(base).then_some(base)
            });
            let labels =
                rest.split_once('}').unwrap().0.split(',').map(|pair| pair.split_once('=').unwrap().0.to_owned());
            let entry = found.get_mut(base.unwrap_or(name)).unwrap();
            entry.1.extend(labels.filter(|label| label != "le"));
        }
    }
    found
}

/// The tables below `## Prometheus`: a section for every service, and one for all of them.
fn documented(service: &str) -> Catalogue {
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/metrics.md")).unwrap();
    let mut found = Catalogue::new();
    let mut section = "";
    for line in text.lines() {
        if line.starts_with('#') {
            section = line.trim_start_matches("### ");
        }
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        if cells.len() == 7 && (section == service || section == "every service") && cells[1].starts_with('`') {
            let labels = cells[3].split(',').map(|label| label.trim().trim_matches('`').to_owned());
            let entry = (cells[2].to_owned(), labels.filter(|label| !label.is_empty()).collect());
            let twice = found.insert(cells[1].trim_matches('`').to_owned(), entry);
            assert!(twice.is_none(), "docs/metrics.md lists {} twice", cells[1]);
        }
    }
    found
}

/// The value of a sample, by its name and labels as they are written.
fn value(text: &str, sample: &str) -> f64 {
    let line = text.lines().find_map(|line| line.strip_prefix(sample)?.strip_prefix(' '));
    line.unwrap_or_else(|| panic!("{sample} is not in\n{text}")).parse().unwrap()
}

#[test]
fn a_scrape_is_the_catalogue_and_the_ledger_balances() {
    let config = small(ExecutorKind::Local, 5, 40);
    let mut cluster = Cluster::start_with(&config, options(&["--http", "127.0.0.1:0"]));
    cluster.start_actor();
    wait_until("a few iterations", || cluster.iterations() >= 4);
    let services: BTreeSet<&str> = cluster.pages.iter().map(|page| page.0.as_str()).collect();
    assert_eq!(services, BTreeSet::from(["learner", "commander", "actor"]));
    for (service, address) in &cluster.pages {
        let text = get(address, "/metrics");
        let (scraped, documented) = (scraped(&text), documented(service));
        let names = |a: &Catalogue, b: &Catalogue| {
            a.iter().filter(|(name, entry)| b.get(*name) != Some(entry)).map(|e| format!("{e:?}")).collect::<Vec<_>>()
        };
        let (more, less) = (names(&scraped, &documented), names(&documented, &scraped));
        assert!(more.is_empty(), "{service} shows what docs/metrics.md does not list so: {more:#?}");
        assert!(less.is_empty(), "docs/metrics.md lists what {service} does not show so: {less:#?}");
        let own = format!("magex_{service}_");
        assert!(scraped.keys().all(|name| name.starts_with(&own) || name.starts_with("process_")));
        assert_eq!(get(address, "/healthz").lines().last(), Some("ok"));
    }
    let page = |service: &str| get(&cluster.pages.iter().find(|page| page.0 == service).unwrap().1, "/metrics");
    let learner = page("learner");
    for counted in ["shards", "episodes"] {
        let of = |what: &str| value(&learner, &format!("magex_learner_{counted}_{what}"));
        let ended = ["trained", "duplicate", "expired", "rejected", "failed"].map(|what| of(&format!("{what}_total")));
        assert_eq!(of("leased_total"), ended.iter().sum::<f64>() + of("outstanding"));
        assert!(of("residual") == 0.0 && of("trained_total") > 0.0);
    }
    let steps = |name: &str| value(&learner, &format!("magex_learner_{name}_steps_total"));
    assert_eq!(steps("agent"), 5.0 * steps("joint"));
    assert!(steps("joint") >= 3.0 * 8.0 * 20.0, "{}", steps("joint"));
    assert_eq!(value(&learner, "magex_learner_actors_live"), 1.0);
    assert_eq!(value(&learner, "magex_learner_subscribers{role=\"commander\"}"), 1.0);
    assert_eq!(value(&learner, "magex_learner_policy_lag_versions{stat=\"max\"}"), 0.0);
    let actor = page("actor");
    assert!(value(&actor, "magex_actor_joint_steps_total{kind=\"train\"}") >= 3.0 * 8.0 * 20.0);
    assert!(
        value(&actor, "magex_actor_upload_bytes_total") > 0.0
            && value(&actor, "magex_actor_rollout_seconds_count") > 0.0
    );
    let commander = page("commander");
    assert!(value(&commander, "magex_commander_calls_total{code=\"Ok\",method=\"AssignBatch\"}") > 0.0);
    assert!(value(&commander, "magex_commander_answers_total{scheduler=\"learned\"}") > 0.0);

    assert_eq!(cluster.finish(), train(&config, tempfile::tempdir().unwrap().path(), 1, 1).sha256);
    let log = cluster.learner.log();
    for counted in ["shards", "episodes"] {
        let line = log.lines().find(|line| line.contains("ledger") && line.contains(&format!("counted=\"{counted}\"")));
        let line = line.unwrap_or_else(|| panic!("no ledger of {counted} in\n{log}"));
        assert!(line.contains("residual=0"), "{line}");
    }
    assert!(log.contains("bottleneck="), "{log}");
}
