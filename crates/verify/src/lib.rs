//! Checks the simulators, the drone controller and the assignment solver against recordings of other programs.
//!
//! | module | recordings of |
//! |---|---|
//! | `particles` | the authors' particle simulator (Simple Spread, Push Ball) |
//! | `drones` | gym-pybullet-drones: flights, controller calls, forces |
//! | `assignment` | optimal assignments (scipy) |
//!
//! [`verify_dir`] checks every JSON file below a folder by the `format` that the file names. Files of other formats are
//! listed and skipped. A file of a supported format that cannot be read is a failure, and so is a folder without any
//! supported recording.

mod assignment;
mod drones;
mod particles;
mod reader;
mod report;

pub use report::Check;

use magex_core::error::FieldError;
use reader::Field;
use report::Report;
use std::fmt;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// A folder that cannot be read.
#[derive(Debug, Error)]
#[error("{path}: {source}")]
pub struct VerifyError {
    path: String,
    source: std::io::Error,
}

/// The result for a file.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// Every difference is within its limit.
    Agrees,
    /// Some difference is not, or the recording is malformed; in words.
    Fails(Vec<String>),
    /// Not a recording this version can check; in words.
    Skipped(String),
}

/// One file.
#[derive(Debug, Clone, PartialEq)]
pub struct FileReport {
    /// Relative to the folder that was checked.
    pub path: PathBuf,
    /// Format that the file names; empty if it names none.
    pub format: String,
    /// What was compared, for example `N = 50, 120 steps`.
    pub content: String,
    /// The measured differences.
    pub checks: Vec<Check>,
    /// The verdict.
    pub outcome: Outcome,
}

/// All files, in the order of their paths. Displays as a table.
#[derive(Debug, Clone, PartialEq)]
pub struct VerifyReport {
    /// The files with a name ending in `.json`.
    pub files: Vec<FileReport>,
}

impl VerifyReport {
    /// Files that were checked and agree.
    pub fn agreeing(&self) -> usize {
        self.count(|outcome| matches!(outcome, Outcome::Agrees))
    }

    /// Files that were checked, or should have been, and fail.
    pub fn failing(&self) -> usize {
        self.count(|outcome| matches!(outcome, Outcome::Fails(_)))
    }

    /// Files this version cannot check.
    pub fn skipped(&self) -> usize {
        self.count(|outcome| matches!(outcome, Outcome::Skipped(_)))
    }

    /// True if something was checked and nothing failed.
    pub fn passed(&self) -> bool {
        self.agreeing() > 0 && self.failing() == 0
    }

    fn count(&self, is: impl Fn(&Outcome) -> bool) -> usize {
        self.files.iter().filter(|file| is(&file.outcome)).count()
    }
}

/// Checks every `.json` file below `dir` (or the one file `dir` is). Links to folders are not followed.
///
/// # Errors
/// A folder that cannot be read. A file that cannot is a failure in the report.
pub fn verify_dir(dir: &Path) -> Result<VerifyReport, VerifyError> {
    let mut paths = Vec::new();
    if dir.is_file() {
        paths.push(dir.to_owned());
    } else {
        walk(dir, &mut paths)?;
    }
    paths.sort();
    let files = paths.iter().map(|path| {
        let shown = path.strip_prefix(dir).ok().filter(|rest| !rest.as_os_str().is_empty()).unwrap_or(path);
        verify_file(shown, std::fs::read_to_string(path))
    });
    Ok(VerifyReport { files: files.collect() })
}

fn walk(dir: &Path, paths: &mut Vec<PathBuf>) -> Result<(), VerifyError> {
    let failed = |source| VerifyError { path: dir.display().to_string(), source };
    for entry in std::fs::read_dir(dir).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let (path, kind) = (entry.path(), entry.file_type().map_err(failed)?);
        if kind.is_dir() {
            walk(&path, paths)?;
        } else if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json")) && path.is_file() {
            paths.push(path);
        }
    }
    Ok(())
}

fn verify_file(path: &Path, text: std::io::Result<String>) -> FileReport {
    let mut format = String::new();
    let compared = match text {
        Ok(text) => compare(&text, &mut format).map_err(|refusal| match refusal {
            Refusal::Unsupported(reason) => Outcome::Skipped(reason),
            Refusal::Malformed(error) => Outcome::Fails(vec![error.to_string()]),
        }),
        Err(error) => Err(Outcome::Fails(vec![error.to_string()])),
    };
    let (report, outcome) = match compared {
        Ok(report) => match report.disagreements() {
            reasons if reasons.is_empty() => (report, Outcome::Agrees),
            reasons => (report, Outcome::Fails(reasons)),
        },
        Err(outcome) => (Report::default(), outcome),
    };
    FileReport { path: path.to_owned(), format, content: report.content, checks: report.checks, outcome }
}

/// Why a file was not compared.
#[derive(Debug, Error)]
enum Refusal {
    /// A recording of another kind; in words.
    #[error("{0}")]
    Unsupported(String),
    /// A recording that is malformed; names the field.
    #[error(transparent)]
    Malformed(#[from] FieldError),
}

/// Compares a recording; `format` becomes the format that it names.
fn compare(text: &str, format: &mut String) -> Result<Report, Refusal> {
    let value: serde_json::Value =
        serde_json::from_str(text).map_err(|e| FieldError::new("recording", format!("not valid JSON: {e}")))?;
    let root = Field::root(&value);
    root.get("format")?.text()?.clone_into(format);
    match format.as_str() {
        particles::FORMAT => {
            let scenario = root.get("scenario")?.text()?;
            if particles::SCENARIOS.contains(&scenario) {
                return Ok(particles::verify(&root)?);
            }
            let known = particles::SCENARIOS.join(" or ");
            let reason = format!("scenario: '{scenario}' is not supported; use a recording of scenario {known}");
            Err(Refusal::Unsupported(reason))
        }
        assignment::FORMAT => Ok(assignment::verify(&root)?),
        drones::FLIGHT => Ok(drones::verify_flight(&root)?),
        drones::CALLS => Ok(drones::verify_calls(&root)?),
        drones::FORCES => Ok(drones::verify_forces(&root)?),
        other => Err(Refusal::Unsupported(format!("format {other} is not supported by this version"))),
    }
}

impl fmt::Display for VerifyReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = self.files.iter().map(|file| file.path.display().to_string().chars().count()).max().unwrap_or(0);
        for file in &self.files {
            let verdict = match file.outcome {
                Outcome::Agrees => "ok",
                Outcome::Fails(_) => "FAIL",
                Outcome::Skipped(_) => "skip",
            };
            write!(f, "{verdict:<4}  {:<width$}", file.path.display().to_string())?;
            if !file.content.is_empty() {
                write!(f, "  {}", file.content)?;
            }
            for check in &file.checks {
                write!(f, "  {} {:.1e} ", check.what, check.worst)?;
                match check.limit {
                    Some(limit) => write!(f, "(≤ {limit:e})")?,
                    None => write!(f, "(for information: {})", check.words)?,
                }
            }
            match &file.outcome {
                Outcome::Agrees => writeln!(f)?,
                Outcome::Skipped(reason) => writeln!(f, "  skipped: {reason}")?,
                Outcome::Fails(reasons) => {
                    writeln!(f)?;
                    // The first reasons suffice; a thousand would hide the table.
                    for reason in reasons.iter().take(5) {
                        writeln!(f, "      {reason}")?;
                    }
                    if reasons.len() > 5 {
                        writeln!(f, "      and {} more", reasons.len() - 5)?;
                    }
                }
            }
        }
        let (agreeing, failing, skipped) = (self.agreeing(), self.failing(), self.skipped());
        write!(f, "{agreeing} agree, {failing} fail, {skipped} skipped")?;
        if agreeing + failing == 0 {
            let known =
                [particles::FORMAT, assignment::FORMAT, drones::FLIGHT, drones::CALLS, drones::FORCES].join(", ");
            write!(f, "; FAIL: no recording of a supported format ({known})")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = r#"{"format":"assignment-golden-1","cases":[{"rows":2,"cols":2,"matrix":[1,2,2,1],
        "row_ind":[0,1],"col_ind":[0,1],"cost":2,"unique":true}]}"#;

    fn verify(text: &str) -> FileReport {
        verify_file(Path::new("case.json"), Ok(text.to_owned()))
    }

    #[test]
    fn a_recording_agrees_fails_or_is_skipped_with_a_reason() {
        let good = verify(GOOD);
        assert_eq!((good.outcome, good.checks[0].worst), (Outcome::Agrees, 0.0));
        for (text, reason) in [
            (GOOD.replace("\"cost\":2", "\"cost\":3"), "cost 2 differs from 3"),
            (GOOD.replace("\"cost\":2", "\"cost\":\"2\""), "cases[0].cost"),
            ("{".into(), "recording: not valid JSON"),
            ("[]".into(), "recording: must be an object"),
            ("{}".into(), "format: is missing"),
            (r#"{"format":"mpe-golden-1"}"#.into(), "scenario"),
        ] {
            let Outcome::Fails(reasons) = verify(&text).outcome else { panic!("{text} passes") };
            assert!(reasons[0].contains(reason), "{reasons:?}");
        }
        let Outcome::Skipped(reason) = verify(r#"{"format":"drone-golden-2"}"#).outcome else { panic!("not skipped") };
        assert_eq!(reason, "format drone-golden-2 is not supported by this version");
        let Outcome::Fails(reasons) = verify(r#"{"format":"drone-golden-1"}"#).outcome else { panic!("passes") };
        assert!(reasons[0].starts_with("physics"), "{reasons:?}");
    }

    #[test]
    fn a_folder_is_walked_in_order_and_must_hold_something() {
        let dir = std::env::temp_dir().join(format!("magex-verify-{}", std::process::id()));
        std::fs::create_dir_all(dir.join("b/c")).unwrap();
        std::fs::write(dir.join("b/other.json"), r#"{"format":"x"}"#).unwrap();
        std::fs::write(dir.join("b/readme.txt"), "no recording").unwrap();
        let report = verify_dir(&dir).unwrap();
        assert!(!report.passed() && report.skipped() == 1);
        assert!(report.to_string().contains("no recording of a supported format"), "{report}");
        std::fs::write(dir.join("b/c/good.json"), GOOD).unwrap();
        std::fs::write(dir.join("a.json"), [0xff, 0xfe]).unwrap();
        let report = verify_dir(&dir).unwrap();
        let paths: Vec<_> = report.files.iter().map(|file| file.path.to_string_lossy().into_owned()).collect();
        assert_eq!(paths, ["a.json", "b/c/good.json", "b/other.json"]);
        assert_eq!((report.agreeing(), report.failing(), report.skipped(), report.passed()), (1, 1, 1, false));
        assert!(verify_dir(&dir.join("b/c/good.json")).unwrap().passed());
        std::fs::remove_dir_all(&dir).unwrap();
        assert!(verify_dir(&dir).unwrap_err().to_string().contains("magex-verify"));
    }
}
