//! Reads Rust sources as far as the rules need it: comments and literals apart from code, tests apart from the product.
//! Needs no build and no parser crate, so that it reads any checkout.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// `text` with comments and the contents of literals blanked out; every line keeps its number and its length in bytes.
pub(crate) fn code_only(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = bytes.to_vec();
    let mut at = 0;
    while at < bytes.len() {
        let end = literal_or_comment(bytes, at);
        if end == at {
            at += 1;
            continue;
        }
        out[at..end].iter_mut().filter(|byte| **byte != b'\n').for_each(|byte| *byte = b' ');
        at = end;
    }
    String::from_utf8(out).unwrap()
}

/// Where the comment or literal that begins at `at` ends; `at` itself where none begins.
fn literal_or_comment(bytes: &[u8], at: usize) -> usize {
    let rest = &bytes[at..];
    let find = |from: usize, what: &[u8]| {
        bytes[from..].windows(what.len()).position(|part| part == what).map_or(bytes.len(), |k| from + k + what.len())
    };
    let word_before = at > 0 && (bytes[at - 1].is_ascii_alphanumeric() || bytes[at - 1] == b'_');
    match rest {
        [b'/', b'/', ..] => bytes[at..].iter().position(|&b| b == b'\n').map_or(bytes.len(), |k| at + k),
        [b'/', b'*', ..] => find(at + 2, b"*/"),
        [b'"', ..] => end_of_string(bytes, at + 1),
        [b'b', b'"', ..] if !word_before => end_of_string(bytes, at + 2),
        [b'r', b'"' | b'#', ..] | [b'b', b'r', b'"' | b'#', ..] if !word_before => {
            let open = at + rest.iter().position(|&b| b == b'r').unwrap() + 1;
            let hashes = bytes[open..].iter().take_while(|&&b| b == b'#').count();
            if bytes.get(open + hashes) != Some(&b'"') {
                return at;
            }
            find(open + hashes + 1, format!("\"{}", "#".repeat(hashes)).as_bytes())
        }
        // A character; anything else that begins so is a lifetime.
        [b'\'', b'\\', _, ..] => find(at + 3, b"'"),
        [b'\'', ..] => {
            let text = std::str::from_utf8(&rest[1..rest.len().min(6)]);
            let valid = text.map_or_else(|e| e.valid_up_to(), str::len);
            let first = std::str::from_utf8(&rest[1..1 + valid]).unwrap().chars().next();
            first.map_or(at, |c| if rest.get(1 + c.len_utf8()) == Some(&b'\'') { at + 2 + c.len_utf8() } else { at })
        }
        _ => at,
    }
}

fn end_of_string(bytes: &[u8], mut at: usize) -> usize {
    while at < bytes.len() {
        match bytes[at] {
            b'\\' => at += 2,
            b'"' => return at + 1,
            _ => at += 1,
        }
    }
    bytes.len()
}

/// Byte ranges of the items behind `#[cfg(test)]`, wherever they stand. `code` comes from [`code_only`].
pub(crate) fn test_items(code: &str) -> Vec<std::ops::Range<usize>> {
    const MARK: &str = "#[cfg(test)]";
    let mut found: Vec<std::ops::Range<usize>> = Vec::new();
    for (start, _) in code.match_indices(MARK) {
        if found.last().is_none_or(|last| last.end <= start) {
            found.push(start..end_of_item(code, start + MARK.len()));
        }
    }
    found
}

/// The end of the item at `at`: its `;` or its closing brace; a field, an argument or an arm ends at its comma.
fn end_of_item(code: &str, mut at: usize) -> usize {
    // Further attributes.
    loop {
        at += code[at..].len() - code[at..].trim_start().len();
        if !code[at..].starts_with('#') {
            break;
        }
        at += code[at..].find(']').map_or(code[at..].len(), |k| k + 1);
    }
    let first = identifiers(&code[at..]).find(|word| !matches!(*word, "pub" | "crate" | "super" | "in")).unwrap_or("");
    let by_semicolon = matches!(first, "use" | "const" | "static" | "let" | "type" | "extern");
    let item = by_semicolon
        || matches!(first, "fn" | "mod" | "impl" | "struct" | "enum" | "trait" | "unsafe" | "async" | "macro_rules");
    let mut depth = 0;
    for (k, c) in code[at..].char_indices() {
        match c {
            '(' | '[' | '{' => depth += 1,
            ')' | ']' | '}' => {
                depth -= 1;
                if depth < 0 {
                    return at + k;
                }
                if depth == 0 && c == '}' && !by_semicolon {
                    return at + k + 1;
                }
            }
            ';' if depth == 0 => return at + k + 1,
            ',' if depth == 0 && !item => return at + k + 1,
            _ => {}
        }
    }
    code.len()
}

/// The identifiers and keywords of a text, in order.
pub(crate) fn identifiers(code: &str) -> impl Iterator<Item = &str> {
    code.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|word| !word.is_empty())
}

/// The code of a file without what only tests see; lines keep their numbers.
pub(crate) fn product_code(text: &str) -> String {
    let code = code_only(text);
    let mut out = code.clone().into_bytes();
    for range in test_items(&code) {
        out[range].iter_mut().filter(|byte| **byte != b'\n').for_each(|byte| *byte = b' ');
    }
    String::from_utf8(out).unwrap()
}

/// How many lines of a file, comments and blank lines among them, are not behind `#[cfg(test)]`.
pub(crate) fn product_lines(text: &str) -> usize {
    let items = test_items(&code_only(text));
    let lines_of = |range: &std::ops::Range<usize>| text[range.clone()].matches('\n').count() + 1;
    text.lines().count() - items.iter().map(lines_of).sum::<usize>().min(text.lines().count())
}

/// The modules of one library or binary that are files of their own: path in the crate (`[]` is the root) to file.
#[derive(Debug, Default)]
pub(crate) struct Modules {
    /// Part of the product.
    pub(crate) product: BTreeMap<Vec<String>, PathBuf>,
    /// Behind `#[cfg(test)]`, and everything below such a module.
    pub(crate) tests: BTreeSet<PathBuf>,
}

/// Follows the `mod name;` declarations from a crate's root file.
pub(crate) fn modules(root_file: &Path) -> Modules {
    let mut found = Modules::default();
    follow(root_file, &[], false, &mut found);
    found
}

fn follow(file: &Path, module: &[String], test: bool, found: &mut Modules) {
    let text = std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    let code = code_only(&text);
    if test {
        found.tests.insert(file.to_owned());
    } else {
        found.product.insert(module.to_vec(), file.to_owned());
    }
    let stem = file.file_stem().unwrap().to_string_lossy();
    let beside = module.is_empty() || stem == "mod";
    let folder = if beside { file.parent().unwrap().to_owned() } else { file.with_extension("") };
    let hidden = test_items(&code);
    for (at, _) in code.match_indices("mod ") {
        let whole_word = !code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_');
        let Some((name, _)) = code[at + 4..].split_once(';') else { continue };
        if !whole_word || !name.chars().all(|c| c.is_alphanumeric() || c == '_') {
            continue;
        }
        let candidates = [folder.join(format!("{name}.rs")), folder.join(name).join("mod.rs")];
        let path = path_attribute(&text, &code, at).map(|given| file.parent().unwrap().join(given));
        let Some(next) = path.or_else(|| candidates.into_iter().find(|path| path.exists())) else { continue };
        let below: Vec<String> = module.iter().cloned().chain([name.to_owned()]).collect();
        follow(&next, &below, test || hidden.iter().any(|range| range.contains(&at)), found);
    }
}

/// The file that a `#[path = "..."]` right before the declaration at `at` names.
fn path_attribute(text: &str, code: &str, at: usize) -> Option<String> {
    let from = code[..at].rfind([';', '}']).map_or(0, |k| k + 1);
    let attribute = text[from..at].split("#[path = \"").nth(1)?;
    Some(attribute.split('"').next()?.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SAMPLE: &str = r##"//! mod nothing;
#[cfg(test)]
mod tests;
use std::fmt; // "quote
const A: [u8; 2] = [b'"', b'\''];
struct S<'a> {
    #[cfg(test)]
    seen: Vec<u8>,
    text: &'a str,
}
#[cfg(test)]
#[allow(dead_code)]
fn only_there() {
    let _ = "}";
}
fn product() -> &'static str {
    r#"#[cfg(test)] "fn" "#
}
"##;

    #[test]
    fn comments_and_literals_are_not_code_and_test_items_are_found_anywhere() {
        let code = product_code(SAMPLE);
        assert_eq!(code.len(), SAMPLE.len());
        for gone in ["nothing", "tests", "quote", "seen", "only_there", "cfg(test)"] {
            assert!(!code.contains(gone), "{gone} in {code}");
        }
        for kept in ["use std::fmt;", "[u8; 2]", "text: &'a str", "fn product"] {
            assert!(code.contains(kept), "{kept} not in {code}");
        }
        assert_eq!(product_lines(SAMPLE), 18 - 2 - 2 - 5);
    }
}
