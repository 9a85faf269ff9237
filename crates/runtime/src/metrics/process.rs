//! Metrics of the process, from /proc/self. The `prometheus` crate has them too, but takes 32 s longer to build (`procfs`).

use super::{Metrics, raise_to};
use rustix::param::{clock_ticks_per_second, page_size};
use std::fs;

/// The fields of /proc/self/stat that are exported (proc_pid_stat(5)).
#[derive(Debug, PartialEq)]
struct Stat {
    /// User and system time, clock ticks.
    cpu: u64,
    threads: u64,
    /// Start after boot, clock ticks.
    start: u64,
    virtual_bytes: u64,
    resident_pages: u64,
}

impl Stat {
    fn parse(text: &str) -> Option<Self> {
        // The second field, a name in parentheses, may contain anything.
        let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
        // Fields are numbered from 1 in the manual; the first here is number 3.
        let field = |number: usize| fields.get(number - 3)?.parse::<u64>().ok();
        Some(Self {
            cpu: field(14)? + field(15)?,
            threads: field(20)?,
            start: field(22)?,
            virtual_bytes: field(23)?,
            resident_pages: field(24)?,
        })
    }
}

/// Declares the metrics; a scrape reads them anew.
pub(super) fn declare(metrics: &Metrics) {
    let cpu = metrics.counter("process_cpu_seconds_total", "Total user and system CPU time spent in seconds.");
    let resident = metrics.gauge("process_resident_memory_bytes", "Resident memory size in bytes.");
    let size = metrics.gauge("process_virtual_memory_bytes", "Virtual memory size in bytes.");
    let open = metrics.gauge("process_open_fds", "Number of open file descriptors.");
    let most = metrics.gauge("process_max_fds", "Maximum number of open file descriptors.");
    let threads = metrics.gauge("process_threads", "Number of OS threads in the process.");
    let start = metrics.gauge("process_start_time_seconds", "Start time of the process since unix epoch in seconds.");
    metrics.before_scrape(move || {
        // What cannot be read keeps its last value.
        if let Some(stat) = fs::read_to_string("/proc/self/stat").ok().as_deref().and_then(Stat::parse) {
            raise_to(&cpu, stat.cpu / clock_ticks_per_second());
            resident.set((stat.resident_pages * page_size() as u64) as f64);
            size.set(stat.virtual_bytes as f64);
            threads.set(stat.threads as f64);
            if let Some(boot) = boot_seconds() {
                start.set((boot + stat.start / clock_ticks_per_second()) as f64);
            }
        }
        if let Ok(files) = fs::read_dir("/proc/self/fd") {
            // One of them is the folder that is being read.
            open.set(files.count().saturating_sub(1) as f64);
        }
        most.set(crate::process::open_files() as f64);
    });
}

/// Boot time, seconds since 1970.
fn boot_seconds() -> Option<u64> {
    let text = fs::read_to_string("/proc/stat").ok()?;
    text.lines().find_map(|line| line.strip_prefix("btime "))?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stat_is_parsed_with_any_name() {
        let text = "7 (a) b) S 1 7 7 0 -1 4194304 100 0 0 0 31 11 0 0 20 0 9 0 500 8192 3 18446744073709551615";
        let expected = Stat { cpu: 42, threads: 9, start: 500, virtual_bytes: 8192, resident_pages: 3 };
        assert_eq!(Stat::parse(text), Some(expected));
        assert_eq!(Stat::parse("7 (a) S 1"), None);
    }

    #[test]
    fn a_scrape_has_the_process() {
        let text = Metrics::new().text();
        let value = |name: &str| -> f64 {
            let line = text.lines().find_map(|line| line.strip_prefix(&format!("{name} "))).unwrap();
            line.parse().unwrap()
        };
        assert!(value("process_resident_memory_bytes") > 1e5 && value("process_threads") >= 1.0, "{text}");
        assert!(value("process_open_fds") >= 3.0 && value("process_start_time_seconds") > 1.6e9, "{text}");
        assert!(value("process_max_fds") >= value("process_open_fds"), "{text}");
    }
}
