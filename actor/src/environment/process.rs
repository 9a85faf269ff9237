//! An environment's process: started by a shell, with a socket of its own, and gone with its parent.

use super::EnvironmentError;
use magex_runtime::backoff;
use magex_runtime::sync::lock;
use rustix::process::{Pid, Signal, kill_process_group};
use std::collections::VecDeque;
use std::io::{BufRead as _, BufReader, PipeReader};
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Mutex};

/// Names the socket on which the process listens.
const SOCKET: &str = "MAGEX_ENVIRONMENT_SOCKET";
const HASH_SEED: &str = "PYTHONHASHSEED";
/// Lines of its output that an error quotes.
const LINES: usize = 12;

/// Ends with this value.
#[derive(Debug)]
pub(super) struct Process {
    child: Child,
    /// The process ends when this closes, also if this program is killed.
    _stdin: Option<ChildStdin>,
    folder: PathBuf,
    pub(super) socket: PathBuf,
    last_lines: Arc<Mutex<VecDeque<String>>>,
}

impl Process {
    pub(super) fn start(command: &str) -> Result<Self, EnvironmentError> {
        let failed = |error: std::io::Error| EnvironmentError::Lost(format!("'{command}' cannot be started: {error}"));
        // Short: the path of a socket has at most 107 bytes.
        let folder = std::env::temp_dir().join(format!("magex-{:x}", backoff::random_id()));
        std::fs::DirBuilder::new().create(&folder).map_err(failed)?;
        let socket = folder.join("environment");
        let (output, to_output) = std::io::pipe().map_err(failed)?;
        let errors = to_output.try_clone().map_err(failed)?;
        let mut shell = Command::new("/bin/sh");
        // A group of its own: a terminal's Ctrl-C reaches this program alone, and the whole of it can be ended.
        shell.args(["-c", command]).env(SOCKET, &socket).stdin(Stdio::piped()).stdout(to_output).stderr(errors);
        if std::env::var_os(HASH_SEED).is_none() {
            // Python would iterate over a set of strings in another order in every process.
            shell.env(HASH_SEED, "0");
        }
        let mut child = shell.process_group(0).spawn().map_err(failed)?;
        // Its ends of the pipe are open until then.
        drop(shell);
        let last_lines = Arc::<Mutex<VecDeque<String>>>::default();
        let lines = last_lines.clone();
        let reader = std::thread::Builder::new().name("environment".to_owned());
        reader.spawn(move || forward(output, &lines)).map_err(failed)?;
        Ok(Self { _stdin: child.stdin.take(), child, folder, socket, last_lines })
    }

    /// How it ended, if it has.
    pub(super) fn ended(&mut self) -> Option<String> {
        let status = self.child.try_wait().ok()??;
        // The last lines may still be on their way.
        std::thread::sleep(std::time::Duration::from_millis(50));
        let lines: Vec<String> = lock(&self.last_lines).iter().cloned().collect();
        let quoted = if lines.is_empty() { String::new() } else { format!("; it printed:\n{}", lines.join("\n")) };
        Some(format!("its process ended ({status}){quoted}"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if let Some(group) = Pid::from_raw(self.child.id() as i32) {
            // It may be gone already.
            let _ = kill_process_group(group, Signal::KILL);
        }
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

/// Its output goes to the log, line by line.
fn forward(output: PipeReader, last: &Mutex<VecDeque<String>>) {
    for line in BufReader::new(output).lines() {
        let Ok(line) = line else { return };
        tracing::info!("environment: {line}");
        let mut last = lock(last);
        if last.len() == LINES {
            last.pop_front();
        }
        last.push_back(line);
    }
}
