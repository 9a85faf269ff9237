//! The table that a benchmark prints.

use magex::output::{Output, Table};
use serde_json::Value;

/// One table.
pub(crate) struct Report {
    /// Key in the JSON object.
    pub(crate) name: &'static str,
    /// What is measured.
    title: String,
    table: Table,
    pub(crate) rows: Vec<Value>,
    /// Remarks below the table.
    pub(crate) notes: Vec<String>,
    pub(crate) failed: bool,
}

impl Report {
    pub(crate) fn new(name: &'static str, title: impl Into<String>, left: usize, heading: &[&str]) -> Self {
        let table = Table::new(left, heading);
        Self { name, title: title.into(), table, rows: Vec::new(), notes: Vec::new(), failed: false }
    }

    pub(crate) fn row(&mut self, cells: Vec<String>, value: Value) {
        self.table.row(cells);
        self.rows.push(value);
    }

    /// Prints title, table and notes.
    pub(crate) fn show(&self, output: Output) {
        output.say(format!("{}\n\n{}\n", self.title, self.table));
        for note in &self.notes {
            output.say(format!("  {note}\n"));
        }
    }
}
