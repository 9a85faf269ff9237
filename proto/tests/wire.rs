//! The wire stays readable: nothing of the contract of an earlier commit (`wire/3cfb71e.txt`) is removed, renumbered, retyped or
//! renamed, unless `wire/allowed.txt` gives a reason. What is added is free. The number of a field that goes is not used again.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::collections::{BTreeMap, BTreeSet};

/// Fields of messages, values of enums, methods of services: under the name of their parent and their own name, the number and the
/// type. Methods have no number.
type Items = BTreeMap<(String, String), (String, String)>;

/// Reads a listing as `descriptor.txt` has it.
fn items(listing: &str) -> Items {
    let (mut items, mut parent, mut package) = (Items::new(), String::new(), String::new());
    for line in listing.lines().filter(|line| !line.is_empty()) {
        let Some(item) = line.strip_prefix("  ") else {
            let (kind, name) = line.split_once(' ').unwrap();
            match kind {
                "file" => package = name.split("(package ").nth(1).unwrap().trim_end_matches(')').to_owned(),
                _ => {
                    parent = name.to_owned();
                    // That it is there at all, as what, and where.
                    items.insert((parent.clone(), String::new()), (String::new(), format!("{kind} in {package}")));
                }
            }
            continue;
        };
        let (name, number, kind) = match item.split_once(['(', ':']) {
            // `Assign(AssignRequest) returns (AssignResponse)`
            Some((name, types)) if !name.contains(' ') => (name, "", types),
            // ` 2 coordinates: repeated float`
            Some((numbered, kind)) => {
                let (number, name) = numbered.trim().split_once(' ').unwrap();
                (name, number, kind)
            }
            // ` 1 ASSIGNMENT_METHOD_EXACT`
            None => {
                let (number, name) = item.trim().split_once(' ').unwrap();
                (name, number, "")
            }
        };
        items.insert((parent.clone(), name.trim().to_owned()), (number.to_owned(), kind.trim().to_owned()));
    }
    items
}

/// What a peer of the old contract would misread, each as `Message.field retyped`.
fn breaks(old: &str, new: &str) -> BTreeSet<String> {
    let (old, new) = (items(old), items(new));
    let mut found = BTreeSet::new();
    for ((parent, name), (number, kind)) in &old {
        let item = if name.is_empty() { parent.clone() } else { format!("{parent}.{name}") };
        let at_number = || {
            let same = |((p, _), (n, _)): &(&(String, String), &(String, String))| p == parent && n == number;
            (!number.is_empty()).then(|| new.iter().find(same)).flatten()
        };
        let what = match new.get(&(parent.clone(), name.clone())) {
            Some((other, _)) if other != number => "renumbered",
            Some((_, other)) if other != kind => "retyped",
            Some(_) => continue,
            // With a message that is gone, its fields are; that is said once.
            None if !name.is_empty() && !new.contains_key(&(parent.clone(), String::new())) => continue,
            None => match at_number() {
                Some((_, (_, other))) if other == kind => "renamed",
                Some(_) => "removed, and its number given to another",
                None => "removed",
            },
        };
        found.insert(format!("{item} {what}"));
    }
    found
}

#[test]
fn nothing_of_the_wire_is_removed_renumbered_retyped_or_renamed_without_a_reason() {
    let breaks = breaks(include_str!("wire/3cfb71e.txt"), include_str!("../descriptor.txt"));
    let mut allowed = BTreeSet::new();
    for line in include_str!("wire/allowed.txt").lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        let (item, reason) = line.split_once(": ").unwrap_or_else(|| panic!("allowed.txt: no reason: {line}"));
        assert!(reason.split(' ').count() >= 5, "allowed.txt: the reason says too little: {line}");
        assert!(allowed.insert(item.to_owned()), "allowed.txt: twice: {item}");
    }
    let refused: Vec<&String> = breaks.difference(&allowed).collect();
    assert!(
        refused.is_empty(),
        "peers of commit 3cfb71e would misread this; give new fields new numbers, or add lines with reasons to \
         proto/tests/wire/allowed.txt: {refused:#?}"
    );
    let stale: Vec<&String> = allowed.difference(&breaks).collect();
    assert!(stale.is_empty(), "allowed.txt has lines for what is not broken: {stale:#?}");
}

#[test]
fn every_kind_of_break_is_named() {
    let old = include_str!("wire/3cfb71e.txt");
    assert!(breaks(old, old).is_empty());
    assert!(breaks(old, &old.replace("message Pair\n", "message Pair\n  99 more: string\n")).is_empty());
    for (from, to, named) in [
        ("   2 coordinates: repeated float\n", "", "Positions.coordinates removed"),
        (
            "   2 coordinates: repeated float\n",
            "   9 coordinates: repeated float\n",
            "Positions.coordinates renumbered",
        ),
        ("   2 coordinates: repeated float\n", "   2 coordinates: repeated double\n", "Positions.coordinates retyped"),
        ("   2 coordinates: repeated float\n", "   2 values: repeated float\n", "Positions.coordinates renamed"),
        (
            "   2 coordinates: repeated float\n",
            "   2 unit: string\n",
            "Positions.coordinates removed, and its number given to another",
        ),
        ("  Assign(AssignRequest) returns (AssignResponse)\n", "", "CommanderService.Assign removed"),
        (
            "  Assign(AssignRequest) returns (AssignResponse)",
            "  Assign(AssignRequest) returns (stream AssignResponse)",
            "CommanderService.Assign retyped",
        ),
        ("message FieldProblem\n", "message Problem\n", "FieldProblem removed"),
        ("   2 MEMBER_STATE_FAILED\n", "   5 MEMBER_STATE_FAILED\n", "MemberState.MEMBER_STATE_FAILED renumbered"),
        ("   2 MEMBER_STATE_FAILED\n", "   2 MEMBER_STATE_DOWN\n", "MemberState.MEMBER_STATE_FAILED renamed"),
    ] {
        let new = old.replacen(from, to, 1);
        assert_ne!(new, old, "{from} is not in the listing");
        assert!(breaks(old, &new).contains(named), "{named}: {:?}", breaks(old, &new));
    }
}
