//! Cycles between the modules of a crate.

use crate::rust::{Modules, product_code};
use std::collections::{BTreeMap, BTreeSet};

type Path = Vec<String>;

/// Groups of modules that use each other in a circle: the strongly connected components of more than one module.
///
/// A module is a file. An edge is a path that begins with `crate::`, `super::` or `self::`, in a `use` or anywhere else,
/// and leads to an item of another module, through re-exports to where the item is defined. Between a module and those
/// above or below it there is no edge: `mod` and `pub use` are what a folder is made of.
pub(crate) fn cycles(modules: &Modules) -> Vec<BTreeSet<String>> {
    let sources: BTreeMap<Path, String> = modules
        .product
        .iter()
        .map(|(module, file)| (module.clone(), product_code(&std::fs::read_to_string(file).unwrap())))
        .collect();
    let paths: BTreeMap<&Path, Vec<(Path, bool)>> =
        sources.iter().map(|(module, code)| (module, paths(code, module))).collect();
    let mut exports: BTreeMap<(Path, String), Path> = BTreeMap::new();
    for (module, found) in &paths {
        for (path, public) in found.iter().filter(|(path, public)| *public && path.len() > 1) {
            debug_assert!(public);
            exports.insert(((*module).clone(), path.last().unwrap().clone()), path.clone());
        }
    }
    let mut reach: BTreeMap<&Path, BTreeSet<Path>> = BTreeMap::new();
    for (module, found) in &paths {
        let uses = found.iter().filter(|(_, public)| !public);
        let targets = uses.map(|(path, _)| resolve(path, &sources, &exports));
        let apart = |target: &Path| !target.starts_with(module) && !module.starts_with(target);
        reach.insert(module, targets.filter(apart).collect());
    }
    // The transitive closure; crates have a hundred modules at most.
    loop {
        let before: usize = reach.values().map(BTreeSet::len).sum();
        for module in sources.keys() {
            let further: Vec<Path> = reach[module].iter().flat_map(|next| reach[next].iter().cloned()).collect();
            reach.get_mut(module).unwrap().extend(further);
        }
        if reach.values().map(BTreeSet::len).sum::<usize>() == before {
            break;
        }
    }
    let mut found = BTreeSet::new();
    for module in sources.keys().filter(|module| reach[module].contains(*module)) {
        let group = reach[module].iter().filter(|other| reach[other].contains(module));
        found.insert(group.map(|path| path.join("::")).collect::<BTreeSet<String>>());
    }
    found.into_iter().collect()
}

/// The module that defines what `path` names.
fn resolve(path: &Path, sources: &BTreeMap<Path, String>, exports: &BTreeMap<(Path, String), Path>) -> Path {
    let mut path = path.clone();
    for _ in 0..8 {
        let depth = (0..=path.len()).rev().find(|&k| sources.contains_key(&path[..k])).unwrap_or(0);
        let next = path.get(depth).and_then(|name| exports.get(&(path[..depth].to_vec(), name.clone())));
        match next {
            Some(to) if *to != path => path = to.clone(),
            _ => return path[..depth].to_vec(),
        }
    }
    panic!("{path:?} is re-exported in a circle")
}

/// Every path within the crate that `code` names, from the crate's root, and whether it is a re-export.
fn paths(code: &str, module: &Path) -> Vec<(Path, bool)> {
    let tokens = tokens(code);
    let mut found = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        let begins = at == 0 || tokens[at - 1] != "::";
        let root = match tokens[at] {
            "crate" => Some(Vec::new()),
            "self" => Some(module.clone()),
            "super" => Some(module[..module.len().saturating_sub(1)].to_vec()),
            _ => None,
        };
        let public_use = public_use(&tokens, at);
        if let Some(root) = root.filter(|_| begins && tokens.get(at + 1) == Some(&"::")) {
            let mut ends = Vec::new();
            at = tree(&tokens, at + 2, root, &mut ends);
            found.extend(ends.into_iter().map(|path| (path, public_use)));
        } else if public_use && tokens[at - 1] == "use" {
            // `pub use child::Name`.
            let mut ends = Vec::new();
            at = tree(&tokens, at, module.clone(), &mut ends);
            found.extend(ends.into_iter().map(|path| (path, true)));
        } else {
            at += 1;
        }
    }
    found
}

/// Whether the path that begins at `at` stands right behind `pub use` or `pub(crate) use`.
fn public_use(tokens: &[&str], at: usize) -> bool {
    if at < 2 || tokens[at - 1] != "use" {
        return false;
    }
    tokens[at - 2] == "pub" || (tokens[at - 2] == ")" && tokens[..at - 2].iter().rev().take(5).any(|t| *t == "pub"))
}

/// Reads the rest of a path, with its `{..}`, into whole paths; the place behind it.
fn tree(tokens: &[&str], mut at: usize, mut path: Path, ends: &mut Vec<Path>) -> usize {
    while let Some(&token) = tokens.get(at) {
        match token {
            "super" => {
                path.pop();
            }
            "{" => {
                at += 1;
                while at < tokens.len() && tokens[at] != "}" {
                    at = if tokens[at] == "," { at + 1 } else { tree(tokens, at, path.clone(), ends) };
                }
                return at + 1;
            }
            "self" | "*" => {}
            name if name.starts_with(|c: char| c.is_alphabetic() || c == '_') => path.push(name.to_owned()),
            _ => break,
        }
        at += 1;
        if tokens.get(at) != Some(&"::") {
            break;
        }
        at += 1;
    }
    ends.push(path);
    // `as Name`
    if tokens.get(at) == Some(&"as") { at + 2 } else { at.max(1) }
}

fn tokens(code: &str) -> Vec<&str> {
    let mut out = Vec::new();
    let mut rest = code.trim_start();
    while let Some(first) = rest.chars().next() {
        let word = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
        let length = if rest.starts_with("::") { 2 } else { word.max(first.len_utf8()) };
        out.push(&rest[..length]);
        rest = rest[length..].trim_start();
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rust::modules;

    fn of(files: &[(&str, &str)]) -> Vec<BTreeSet<String>> {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        cycles(&modules(&folder.path().join("lib.rs")))
    }

    #[test]
    fn two_modules_that_name_each_other_are_a_cycle() {
        let found = of(&[
            ("lib.rs", "mod a; mod b; mod c;"),
            ("a.rs", "use crate::{b::B, c};"),
            ("b.rs", "fn f() { crate::a::g() }"),
            ("c.rs", "pub struct C; #[cfg(test)] mod tests { use crate::a::A; }"),
        ]);
        assert_eq!(found, [BTreeSet::from(["a".to_owned(), "b".to_owned()])]);
    }

    #[test]
    fn a_cycle_through_a_re_export_is_found_and_a_folder_with_its_parts_is_none() {
        let parts = [("lib.rs", "mod a; mod b; pub use b::B;"), ("b.rs", "use super::a; pub struct B;")];
        assert_eq!(of(&[parts[0], parts[1], ("a.rs", "use crate::B;")]).len(), 1);
        assert_eq!(of(&[parts[0], parts[1], ("a.rs", "pub struct A;")]).len(), 0);
        let folder = [("lib.rs", "mod a;"), ("a.rs", "mod b; pub use b::B; struct A;"), ("a/b.rs", "use super::A;")];
        assert_eq!(of(&folder).len(), 0);
    }
}
