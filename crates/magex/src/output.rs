//! Results on standard output: text and tables, or one JSON object on the last line.

use magex_runtime::telemetry;
use serde_json::Value;
use std::io::{IsTerminal as _, Write as _};

pub use magex_core::metrics_table::share;

/// Where results go. With `--json` standard output carries only the JSON object, and text goes to standard error.
#[derive(Debug, Clone, Copy)]
pub struct Output {
    json: bool,
}

impl Output {
    /// Text, or JSON.
    pub fn new(json: bool) -> Self {
        Self { json }
    }

    /// Prints text.
    pub fn say(&self, text: impl AsRef<str>) {
        let text = text.as_ref();
        if self.json {
            return telemetry::line("INFO", text, None);
        }
        // A closed pipe is no error.
        let _ = writeln!(std::io::stdout().lock(), "{text}");
    }

    /// Prints the machine-readable result.
    pub fn result(&self, value: &Value) {
        if self.json {
            let mut stdout = std::io::stdout().lock();
            let _ = writeln!(stdout, "{value}").and_then(|()| stdout.flush());
        }
    }
}

/// Prints a line to standard error.
pub fn note(text: impl AsRef<str>) {
    crate::logging::around_live_line(|| telemetry::line("INFO", text.as_ref(), None));
}

/// Reports the error that ends the process.
pub(crate) fn fatal(text: &str, code: u8, json: bool) {
    let message = if telemetry::is_json() { text.to_owned() } else { format!("error: {text}") };
    crate::logging::around_live_line(|| telemetry::line("ERROR", &message, Some(code)));
    Output::new(json).result(&serde_json::json!({ "error": text, "exit_code": code }));
}

pub(crate) fn colours() -> bool {
    std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none()
}

/// A table with a heading; the first `left` columns are aligned left, numbers to the right.
#[derive(Debug, Clone)]
pub struct Table {
    left: usize,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// With the names of the columns.
    pub fn new(left: usize, heading: &[&str]) -> Self {
        Self { left, rows: vec![heading.iter().map(|&cell| cell.to_owned()).collect()] }
    }

    /// Adds a row.
    pub fn row(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }

    /// The same table if it fits into a number of columns, or else turned: its columns are rows, where that is narrower.
    pub fn within(self, columns: usize) -> Self {
        let width = |table: &Self| table.to_string().lines().map(|line| line.chars().count()).max().unwrap_or(0);
        let own = width(&self);
        if own <= columns {
            return self;
        }
        let rows = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let cell = |row: &Vec<String>, k: usize| row.get(k).cloned().unwrap_or_default();
        let turned = (0..rows).map(|k| self.rows.iter().map(|row| cell(row, k)).collect()).collect();
        let turned = Self { left: 1, rows: turned };
        if width(&turned) < own { turned } else { self }
    }
}

impl std::fmt::Display for Table {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let width = |c: usize| self.rows.iter().filter_map(|r| r.get(c)).map(|x| x.chars().count()).max().unwrap_or(0);
        let widths: Vec<usize> = (0..columns).map(width).collect();
        for (index, row) in self.rows.iter().enumerate() {
            let cells = row.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| {
                if column < self.left { format!("{cell:<width$}") } else { format!("{cell:>width$}") }
            });
            let end = if index == 0 { "" } else { "\n" };
            write!(f, "{end}  {}", cells.collect::<Vec<_>>().join("   ").trim_end())?;
        }
        Ok(())
    }
}

/// 12345.6 → `12,346`; at least zero.
pub fn thousands(value: f64) -> String {
    indicatif::HumanCount(value.round_ties_even() as u64).to_string()
}

/// A span of time.
pub fn seconds(value: f64) -> String {
    if value < 100.0 {
        format!("{value:.1} s")
    } else {
        format!("{:.0} min {:02.0} s", (value / 60.0).floor(), (value % 60.0).floor())
    }
}

/// How this program was called, for hints about the next command.
pub(crate) fn program() -> String {
    if std::env::var_os("CARGO_MANIFEST_DIR").is_some() {
        return if cfg!(debug_assertions) { "cargo run --".into() } else { "cargo run --release --".into() };
    }
    let Ok(path) = std::env::current_exe() else { return "magex".into() };
    let on_path = std::env::var_os("PATH").is_some_and(|all| {
        std::env::split_paths(&all).any(|folder| folder.join("magex").canonicalize().is_ok_and(|p| p == path))
    });
    if on_path {
        return "magex".into();
    }
    let here = std::env::current_dir().unwrap_or_default();
    path.strip_prefix(&here).map_or_else(|_| path.display().to_string(), |rest| format!("./{}", rest.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_formatted() {
        assert_eq!(
            ["0", "999", "1,000", "1,234,568"],
            [0.4, 999.0, 1000.0, 1_234_567.8].map(thousands).each_ref().map(|s| s.as_str())
        );
        assert_eq!(["0.9999", "1.0000", "0.1235"], [0.99999, 1.0, 0.12345].map(share).each_ref().map(|s| s.as_str()));
        assert_eq!(["9.3 s", "2 min 05 s"], [9.26, 125.9].map(seconds).each_ref().map(|s| s.as_str()));
    }

    #[test]
    fn columns_line_up() {
        let mut table = Table::new(1, &["name", "value"]);
        table.row(vec!["a".into(), "1.25".into()]);
        table.row(vec!["longer".into(), "10.25".into()]);
        assert_eq!(table.to_string(), "  name     value\n  a         1.25\n  longer   10.25");
        assert_eq!(table.clone().within(80).to_string(), table.to_string());
        // Turned it would be wider still.
        assert_eq!(table.clone().within(10).to_string(), table.to_string());
        let mut wide = Table::new(1, &["name", "first", "second"]);
        wide.row(vec!["a".into(), "1".into(), "20".into()]);
        assert_eq!(wide.within(20).to_string(), "  name      a\n  first     1\n  second   20");
    }
}
