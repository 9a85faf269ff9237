//! The process itself: its environment, its limits and its one line of standard output.

use crate::log_line::timestamp;
use std::ffi::OsString;
use std::io::Write as _;
use std::net::SocketAddr;
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// Variables that the C library and the tensor library read before `main`; see [`ARENAS`] for one more.
const ENVIRONMENT: [(&str, &str); 4] = [
    // The tensor library must not start threads of its own.
    ("RAYON_NUM_THREADS", "1"),
    ("CANDLE_NUM_THREADS", "1"),
    // The upper end of glibc's dynamic thresholds. With lower ones, each training step returns its buffers to the system and
    // maps them again, which is three times slower.
    ("MALLOC_MMAP_THRESHOLD_", "33554432"),
    ("MALLOC_TRIM_THRESHOLD_", "67108864"),
];

/// Number of glibc arenas. The default is eight per processor, and each keeps its peak; with one per processor, a learner with
/// 200 actors needs a third less memory and is no slower.
const ARENAS: &str = "MALLOC_ARENA_MAX";

/// Variables that mean nothing when they are empty: a composition passes on what is not set as an empty text.
const OPTIONAL: [&str; 2] = ["RUST_LOG", "NO_COLOR"];
/// What the names of more of them begin with.
const OPTIONAL_PREFIXES: [&str; 2] = ["MAGEX_", "OTEL_"];

/// Re-executes this program with the environment that it needs (single-threaded tensor kernels, an allocator that keeps its
/// buffers, no empty variables), unless it has that already; variables that are set are not changed. `main` calls this before it
/// starts a thread. A debugger or `strace` sees the `exec`; to avoid it, set the variables. [`log_environment`] logs them once
/// logging is set up.
pub fn ensure_environment() -> std::io::Result<()> {
    let arenas = processors().to_string();
    let needed = ENVIRONMENT.into_iter().chain([(ARENAS, arenas.as_str())]);
    let mut missing = needed.filter(|(name, _)| std::env::var_os(name).is_none_or(|value| value.is_empty())).peekable();
    let empty: Vec<OsString> =
        std::env::vars_os().filter_map(|(name, value)| value.is_empty().then_some(name)).collect();
    let mut unset = empty.iter().filter(|name| is_optional(&name.to_string_lossy())).peekable();
    if missing.peek().is_none() && unset.peek().is_none() {
        return Ok(());
    }
    let mut command = Command::new(std::env::current_exe()?);
    let mut arguments = std::env::args_os();
    if let Some(name) = arguments.next() {
        // The program's behaviour may depend on the name it was called by.
        command.arg0(name);
    }
    unset.for_each(|name| {
        command.env_remove(name);
    });
    Err(command.args(arguments).envs(missing).exec())
}

fn is_optional(name: &str) -> bool {
    OPTIONAL.contains(&name) || OPTIONAL_PREFIXES.iter().any(|prefix| name.starts_with(prefix))
}

/// Logs, at debug level, the variables for which [`ensure_environment`] re-executes the program.
pub fn log_environment() {
    for name in ENVIRONMENT.iter().map(|(name, _)| *name).chain([ARENAS]) {
        let value = std::env::var_os(name).unwrap_or_default();
        tracing::debug!(variable = name, value = %value.to_string_lossy(), "environment, set by re-executing the program if it was unset");
    }
}

/// The line that reports to a supervisor where a service listens: `{"ready":true,"service":"learner","address":"127.0.0.1:7000"}`,
/// with `"http"`, the address of its metrics, if there is one, and `"timestamp"`, so that it finds its place among log lines.
fn ready_line(service: &str, address: Option<SocketAddr>, http: Option<SocketAddr>, timestamp: &str) -> String {
    let json = |address: SocketAddr| serde_json::Value::from(address.to_string());
    let http = http.map_or_else(String::new, |http| format!(",\"http\":{}", json(http)));
    // Written out so that the order of the keys is the documented one.
    format!(
        "{{\"ready\":true,\"service\":{},\"address\":{}{http},\"timestamp\":\"{timestamp}\"}}",
        serde_json::Value::from(service),
        address.map_or(serde_json::Value::Null, json)
    )
}

/// The name of this machine or container, in one word.
pub fn host() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    host.split_whitespace().next().unwrap_or("host").to_owned()
}

/// A readable name of this process: host and process number.
pub fn default_name() -> String {
    format!("{}-{}", host(), std::process::id())
}

/// The limit of open files of this process.
pub fn open_files() -> usize {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
    limit.map_or(usize::MAX, |limit| usize::try_from(limit).unwrap_or(usize::MAX))
}

/// Raises the limit of open files to the hard limit: connections are files.
pub fn allow_open_files() {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile);
    let most = rustix::process::Rlimit { current: limit.maximum, ..limit };
    // On failure the service accepts fewer connections.
    if let Err(error) = rustix::process::setrlimit(rustix::process::Resource::Nofile, most) {
        tracing::debug!(%error, "the limit of open files cannot be raised");
    }
}

/// Disables transparent huge pages, so that resident memory is the memory in use. With them the kernel maps 2 MiB around every
/// page in use, sometimes hours later, which looks like a leak.
pub fn disable_huge_pages() {
    // Fails on a kernel without huge pages.
    if let Err(error) = rustix::thread::disable_transparent_huge_pages(true) {
        tracing::debug!(%error, "transparent huge pages cannot be disabled");
    }
}

/// The processors that this process may use.
pub fn processors() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Writes requested text (an effective configuration) to standard output.
pub fn print(text: &str) {
    // A closed pipe is not an error.
    let _ = std::io::stdout().lock().write_all(text.as_bytes());
}

/// Prints the ready line to standard output, the only line that a running service writes there.
pub fn announce_ready(service: &str, address: Option<SocketAddr>, http: Option<SocketAddr>) {
    let mut stdout = std::io::stdout().lock();
    // A closed pipe is not an error.
    let _ = writeln!(stdout, "{}", ready_line(service, address, http, &timestamp())).and_then(|()| stdout.flush());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ready_line_is_json() {
        let at = |port: u16| Some(([127, 0, 0, 1], port).into());
        let line = ready_line("learner", at(12345), None, "T");
        assert_eq!(line, r#"{"ready":true,"service":"learner","address":"127.0.0.1:12345","timestamp":"T"}"#);
        let line = ready_line("actor", None, at(9102), "T");
        assert_eq!(line, r#"{"ready":true,"service":"actor","address":null,"http":"127.0.0.1:9102","timestamp":"T"}"#);
    }
}
