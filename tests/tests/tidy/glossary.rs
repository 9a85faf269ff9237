//! Names that users see are made of the glossary's words.

use crate::documented::configuration;
use crate::workspace::read;
use std::collections::{BTreeMap, BTreeSet};

/// Plain words, units and statistics that names may contain besides the terms of docs/glossary.md.
const PLAIN: &str = "
    all at by env every final first free hz in joint keep kind live max mean min name network open order per phase
    physics radius random scale second size start step steps time total unit value value wait s
    busy bytes call calls connected count cpu ended expected failed failures fds joint length line memory
    messages method processors process resident seconds side sampled spacing state streams threads timing virtual
    wall weights version versions received updates learning rate ratio error index push magex grad graph blocks
    distance proximity progress
";

/// Words of the past: (word, what to say instead).
const OLD: [(&str, &str); 11] = [
    ("bound", "bottleneck"),
    ("crew", "rollout pool"),
    ("divergence", "approx_kl"),
    ("extras", "agent_state"),
    ("gone", "cancelled"),
    ("incarnation", "process_id"),
    ("leash", "parent watch"),
    ("share", "fraction"),
    ("standing", "run folder state"),
    ("tally", "shard timing"),
    ("unsettled", "unacknowledged"),
];

/// Old names that are still in use; the list may only become shorter.
const NOT_YET: [&str; 1] = ["skipped"];

/// The terms of the first column of the glossary's tables, cut into words.
fn glossary(text: &str) -> BTreeSet<String> {
    let rows = text.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| term "));
    rows.filter_map(|row| row.split('|').nth(1)).flat_map(words).collect()
}

/// Whether a word is known, or the word that it is the plural of.
fn knows(known: &BTreeSet<String>, word: &str) -> bool {
    let singular = ["s", "es"].iter().any(|ending| word.strip_suffix(ending).is_some_and(|one| known.contains(one)));
    known.contains(word) || singular
}

fn words(name: &str) -> Vec<String> {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_lowercase).collect()
}

/// Every documented name that a user reads or writes, and where it is documented.
fn names() -> BTreeMap<String, &'static str> {
    let mut names = BTreeMap::new();
    let mut section = String::new();
    for line in configuration().lines() {
        if let Some(name) = line.strip_prefix('[') {
            section = name.trim_end_matches(']').to_owned();
        } else if let Some((key, _)) = line.split_once(" = ") {
            names.insert(format!("{section}.{key}"), "a configuration key");
        }
    }
    let metrics = read("docs/metrics.md");
    for row in metrics.lines().filter(|line| line.starts_with("| `")) {
        for name in row.split('|').nth(1).unwrap_or("").split('`').skip(1).step_by(2) {
            names.insert(name.to_owned(), "docs/metrics.md");
        }
    }
    names
}

#[test]
fn names_are_made_of_the_glossarys_words() {
    let mut known = glossary(&read("docs/glossary.md"));
    known.extend(PLAIN.split_whitespace().map(str::to_owned));
    let names = names();
    assert!(names.len() > 150, "only {} names were found", names.len());
    let mut bad = Vec::new();
    for (name, place) in names {
        for word in words(&name).into_iter().filter(|word| !NOT_YET.contains(&word.as_str())) {
            if let Some((_, better)) = OLD.iter().find(|(old, _)| *old == word) {
                bad.push(format!("{name} ({place}): '{word}' is an old word for {better}"));
            } else if !knows(&known, &word) {
                bad.push(format!("{name} ({place}): docs/glossary.md does not know '{word}'"));
            }
        }
        if name.starts_with("mappo.") && name.ends_with(".minibatch") {
            bad.push(format!("{name} ({place}): a size is called a size"));
        }
    }
    assert!(bad.is_empty(), "{}", bad.join("\n"));
}

#[test]
fn the_glossary_has_no_old_words_and_no_term_twice() {
    let text = read("docs/glossary.md");
    let mut seen = BTreeSet::new();
    for row in text.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| term ")) {
        assert_eq!(row.matches('|').count() - row.matches("\\|").count(), 5, "term, meaning, symbol, where: {row}");
        for term in row.split('|').nth(1).unwrap_or("").split(',') {
            assert!(seen.insert(term.trim().to_owned()), "docs/glossary.md tells '{}' twice", term.trim());
        }
    }
    assert!(seen.len() > 80, "{} terms", seen.len());
    for (old, better) in OLD {
        assert!(!glossary(&text).contains(old), "docs/glossary.md: '{old}' is an old word for {better}");
    }
}
