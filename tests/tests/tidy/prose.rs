//! The language of comments, names, messages and documents: a process or a client is no person.

use crate::workspace::{files, read};
use std::path::Path;

/// Words that hide the subject of a sentence, and idioms. Each is a sequence of words; `_` separates words in a name.
const BANNED: [&str; 10] =
    ["who", "whoever", "nobody", "somebody", "anybody", "everybody", "so many", "so long", "sent away", "told to go"];

/// Files that may contain them: path or folder, reason.
const EXEMPT: [(&str, &str); 2] =
    [("tests/tests/tidy/prose.rs", "the list itself"), ("CHANGELOG.md", "quotes the old messages")];

fn excused(path: &Path) -> bool {
    EXEMPT.iter().any(|(exempt, _)| path.starts_with(exempt))
}

/// (line, phrase) of every banned phrase, also of those that are broken over two lines.
fn phrases(text: &str) -> Vec<(usize, &'static str)> {
    let words: Vec<(usize, String)> = text
        .lines()
        .enumerate()
        .flat_map(|(k, line)| {
            let words = line.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
            words.map(move |word| (k + 1, word.to_lowercase()))
        })
        .collect();
    let mut found = Vec::new();
    for banned in BANNED {
        let phrase: Vec<&str> = banned.split(' ').collect();
        for window in words.windows(phrase.len()) {
            if window.iter().map(|(_, word)| word.as_str()).eq(phrase.iter().copied()) {
                found.push((window[0].0, banned));
            }
        }
    }
    found
}

#[test]
fn a_process_is_no_person() {
    let mut found = Vec::new();
    let endings = [
        ".rs",
        ".md",
        ".proto",
        ".toml",
        ".yaml",
        ".html",
        ".js",
        ".py",
        ".env",
        "run",
        "long",
        "slowest",
        "instruction-sets",
        "certificates",
    ];
    for path in files(&endings).into_iter().filter(|path| !excused(path)) {
        let text = read(&path.to_string_lossy());
        found.extend(phrases(&text).into_iter().map(|(line, what)| format!("{}:{line}: '{what}'", path.display())));
    }
    assert!(found.is_empty(), "name the process, the client or the count instead:\n{}", found.join("\n"));
}

#[test]
fn lines_of_documents_can_be_read() {
    let mut found = Vec::new();
    for path in files(&[".md"]) {
        let text = read(&path.to_string_lossy());
        let mut fenced = false;
        for (k, line) in text.lines().enumerate() {
            fenced ^= line.trim_start().starts_with("```");
            if !fenced && !line.starts_with('|') && line.chars().count() > 300 {
                found.push(format!("{}:{}: {} characters", path.display(), k + 1, line.chars().count()));
            }
        }
    }
    assert!(
        found.is_empty(),
        "one sentence per line, and a sentence is shorter than 300 characters:\n{}",
        found.join("\n")
    );
}

#[test]
fn phrases_are_found_over_lines_and_in_names() {
    assert_eq!(
        phrases("fn told_to_go() {}\n/// so\n/// many, and Whoever\nwhole some body"),
        [(3, "whoever"), (2, "so many"), (1, "told to go")]
    );
}
