//! Limits of this process (open files, file size, threads, memory): whether it can start within them, and what an error at one
//! of them means.

use crate::exit::{Failure, USAGE};
use crate::process::open_files;
use rustix::process::{Resource, getrlimit};
use std::io::{Error, ErrorKind};
use std::path::PathBuf;
use std::sync::Mutex;

/// Files of a process that serves its operators and one client.
pub const FEW_FILES: usize = 20;
/// Files of a learner with its run folder and five connections, or of a supervisor with its services.
pub const FILES: usize = 32;
/// Less memory than any process of a training starts in.
const LEAST_MEMORY: u64 = 48 << 20;

/// Fails if this process cannot open `files` files, start `threads` threads or use memory at all. Nothing was started then.
///
/// # Errors
/// The limit, what is needed, and the remedy.
pub fn require(files: usize, threads: usize) -> Result<(), Failure> {
    let open = open_files();
    if open < files {
        return Err(Failure::usage(format!(
            "the limit of open files is {open} (ulimit -n); {files} are needed: raise the limit"
        )));
    }
    if let Some((limit, name)) = memory().filter(|(limit, _)| *limit < LEAST_MEMORY) {
        return Err(Failure::usage(format!(
            "the limit of memory is {} ({name}); {} are needed at the least: raise the limit",
            size(limit),
            size(LEAST_MEMORY)
        )));
    }
    // The runtime of the services panics where a thread cannot be started.
    let (gate, mut started) = (Mutex::new(()), 0);
    std::thread::scope(|scope| {
        let closed = crate::sync::lock(&gate);
        for _ in 0..threads {
            let wait = || drop(crate::sync::lock(&gate));
            let thread = std::thread::Builder::new().stack_size(64 << 10).spawn_scoped(scope, wait);
            if let Err(error) = thread {
                return Err(no_thread(
                    &error,
                    &format!("of the {threads} threads that are needed, {started} can be started"),
                ));
            }
            started += 1;
        }
        drop(closed);
        Ok(())
    })
}

/// The failure of a process that could not start a thread.
pub fn no_thread(error: &Error, what: &str) -> Failure {
    Failure::new(USAGE, format!("{what} ({error}); {}", threads()))
}

/// The limits that keep a thread from being started, and the remedy.
pub fn threads() -> String {
    let own = |resource, text: &str| getrlimit(resource).current.map(|limit| text.replace('#', &limit.to_string()));
    let limits = [
        own(Resource::Nproc, "processes and threads of this user # (ulimit -u)"),
        cgroup("pids.max", "pids/pids.max").map(|limit| format!("those of this container {limit} (pids.max)")),
        getrlimit(Resource::As).current.map(|limit| format!("address space {} (ulimit -v)", size(limit))),
    ];
    let limits: Vec<String> = limits.into_iter().flatten().collect();
    let limits = if limits.is_empty() { "no limit of this process is known".to_owned() } else { limits.join(", ") };
    format!("limits: {limits}: raise the one that is reached, or use fewer threads and actors")
}

/// The smallest limit of memory, and its name.
pub fn memory() -> Option<(u64, &'static str)> {
    let own = [
        getrlimit(Resource::As).current.map(|limit| (limit, "ulimit -v")),
        getrlimit(Resource::Data).current.map(|limit| (limit, "ulimit -d")),
        cgroup("memory.max", "memory/memory.limit_in_bytes").map(|limit| (limit, "memory.max of the container")),
    ];
    own.into_iter().flatten().min()
}

/// Memory that this process can still get, as far as the system says: what is available, within the limits.
pub fn available_memory() -> Option<u64> {
    let system = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let available = system
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:")?.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    let limit = memory().map(|(limit, _)| limit);
    available.map(|kib| kib << 10).into_iter().chain(limit).min()
}

/// A limit of the control group of this process, in either version of the interface.
fn cgroup(name: &str, first_version: &str) -> Option<u64> {
    let own = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let below = own.lines().find_map(|line| line.strip_prefix("0::/")).unwrap_or_default();
    let root = PathBuf::from("/sys/fs/cgroup");
    let candidates = [root.join(below).join(name), root.join(name), root.join(first_version)];
    candidates.iter().find_map(|path| std::fs::read_to_string(path).ok()?.trim().parse().ok())
}

/// An error of a file with the limit that it met, if it met one.
pub fn explained(error: Error) -> Error {
    let text = match (error.kind(), getrlimit(Resource::Fsize).current) {
        (ErrorKind::FileTooLarge, Some(limit)) => {
            format!("{error}; the limit of file size is {} (ulimit -f): raise it", size(limit))
        }
        _ if error.raw_os_error() == Some(rustix::io::Errno::MFILE.raw_os_error()) => {
            format!("{error}; the limit of open files is {} (ulimit -n): raise it", open_files())
        }
        _ => return error,
    };
    Error::new(error.kind(), text)
}

/// Bytes in words.
pub fn size(bytes: u64) -> String {
    if bytes >= 10 << 20 { format!("{} MiB", bytes >> 20) } else { format!("{} KiB", bytes >> 10) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_is_named_with_its_need_and_the_remedy() {
        require(FILES, 8).unwrap();
        let error = require(usize::MAX, 0).unwrap_err();
        assert_eq!(error.code, USAGE);
        assert!(error.message.contains("ulimit -n") && error.message.contains("raise the limit"), "{error}");
        assert!(threads().contains("limit"));
        assert!(available_memory().is_some_and(|bytes| bytes >= LEAST_MEMORY));
        let other = explained(Error::from(ErrorKind::StorageFull));
        assert_eq!(other.kind(), ErrorKind::StorageFull);
    }
}
