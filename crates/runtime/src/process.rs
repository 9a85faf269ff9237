//! The process itself: its environment and its one line of standard output.

use std::io::Write as _;
use std::net::SocketAddr;
use std::os::unix::process::CommandExt as _;
use std::process::Command;

/// What the C library and the tensor library read of the environment before anything else runs, but for [`ARENAS`].
const ENVIRONMENT: [(&str, &str); 4] = [
    // The tensor library must not start threads of its own.
    ("RAYON_NUM_THREADS", "1"),
    ("CANDLE_NUM_THREADS", "1"),
    // Blocks of up to 32 MiB come from the heap, and the heap keeps up to 64 MiB that are free at its end. It is where glibc's
    // own rule for these two ends with bigger blocks. With smaller ones, as ours are, each step of training gives its buffers
    // back to the system and fetches them again: three times slower.
    ("MALLOC_MMAP_THRESHOLD_", "33554432"),
    ("MALLOC_TRIM_THRESHOLD_", "67108864"),
];

/// Heaps among which glibc's allocator spreads the threads. It takes eight for each processor, and each keeps what its
/// busiest moment needed: with one for each, a learner of 200 actors holds a third less and is no slower.
const ARENAS: &str = "MALLOC_ARENA_MAX";

/// The command that runs this process again in the environment that it needs, or `None` when it has it already. What is set
/// stays as it is.
fn in_its_environment() -> std::io::Result<Option<Command>> {
    let arenas = processors().to_string();
    let missing = || {
        let needed = ENVIRONMENT.into_iter().chain([(ARENAS, arenas.as_str())]);
        needed.filter(|(name, _)| std::env::var_os(name).is_none())
    };
    if missing().next().is_none() {
        return Ok(None);
    }
    let mut command = Command::new(std::env::current_exe()?);
    let mut arguments = std::env::args_os();
    if let Some(name) = arguments.next() {
        // The name by which it was called may say what it shall do.
        command.arg0(name);
    }
    command.args(arguments).envs(missing());
    Ok(Some(command))
}

/// Replaces this process with one that has the environment it needs (single-threaded tensor kernels, an allocator that keeps
/// its buffers), unless it is such a process already. `main` does this before it starts a thread.
pub fn ensure_environment() -> std::io::Result<()> {
    match in_its_environment()? {
        Some(mut command) => Err(command.exec()),
        None => Ok(()),
    }
}

/// The line that tells a supervisor where a service listens: `{"ready":true,"service":"learner","address":"127.0.0.1:7000"}`,
/// with `"http"` and where it shows its metrics as a last key if it does.
pub fn ready_line(service: &str, address: Option<SocketAddr>, http: Option<SocketAddr>) -> String {
    let json = |address: SocketAddr| serde_json::Value::from(address.to_string());
    let http = http.map_or_else(String::new, |http| format!(",\"http\":{}", json(http)));
    // Written out so that the order of the keys is the documented one.
    format!(
        "{{\"ready\":true,\"service\":{},\"address\":{}{http}}}",
        serde_json::Value::from(service),
        address.map_or(serde_json::Value::Null, json)
    )
}

/// A name for this process that means something to a person: host and process number.
pub fn default_name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let host = if host.trim().is_empty() { "host" } else { host.trim() };
    format!("{host}-{}", std::process::id())
}

/// Files that this process may have open at once.
pub fn open_files() -> usize {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
    limit.map_or(usize::MAX, |limit| usize::try_from(limit).unwrap_or(usize::MAX))
}

/// Lets a service open as many files as the system allows it: connections are files.
pub fn allow_open_files() {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile);
    let most = rustix::process::Rlimit { current: limit.maximum, ..limit };
    // Without it there is room for fewer connections.
    if let Err(error) = rustix::process::setrlimit(rustix::process::Resource::Nofile, most) {
        tracing::debug!(%error, "the limit of open files stays as it is");
    }
}

/// Keeps a service to pages of the ordinary size, so that it holds what it uses. With huge ones, which some systems give
/// unasked, the kernel fills 2 MiB wherever one page of them is in use, some of them hours later: memory that grows and is no
/// leak.
pub fn refuse_huge_pages() {
    // A kernel without huge pages has none to refuse.
    if let Err(error) = rustix::thread::disable_transparent_huge_pages(true) {
        tracing::debug!(%error, "huge pages stay as they are");
    }
}

/// The processors that this process may use.
pub fn processors() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Writes text that was asked for (an effective configuration) to standard output.
pub fn print(text: &str) {
    // A reader that closed the pipe does not want to know.
    let _ = std::io::stdout().lock().write_all(text.as_bytes());
}

/// Prints [`ready_line`] to standard output: the only thing a running service ever writes there.
pub fn announce_ready(service: &str, address: Option<SocketAddr>, http: Option<SocketAddr>) {
    let mut stdout = std::io::stdout().lock();
    // A supervisor that closed the pipe does not want to know.
    let _ = writeln!(stdout, "{}", ready_line(service, address, http)).and_then(|()| stdout.flush());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ready_line_is_json() {
        let at = |port: u16| Some(([127, 0, 0, 1], port).into());
        let line = ready_line("learner", at(12345), None);
        assert_eq!(line, r#"{"ready":true,"service":"learner","address":"127.0.0.1:12345"}"#);
        assert_eq!(ready_line("actor", None, None), r#"{"ready":true,"service":"actor","address":null}"#);
        let line = ready_line("actor", None, at(9102));
        assert_eq!(line, r#"{"ready":true,"service":"actor","address":null,"http":"127.0.0.1:9102"}"#);
    }
}
