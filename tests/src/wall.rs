//! The time of day jumps, for some processes.

use std::path::PathBuf;
use std::process::Command;
use std::time::{SystemTime, UNIX_EPOCH};

/// Moves the time of day, and nothing else, by the seconds in a file.
const SHIM: &str = r#"
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
int clock_gettime(clockid_t clock, struct timespec *time) {
  static int (*real)(clockid_t, struct timespec *);
  if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  int code = real(clock, time);
  if (clock != CLOCK_REALTIME) return code;
  FILE *file = fopen(getenv("TEST_CLOCK"), "r");
  long seconds = 0;
  if (file) { if (fscanf(file, "%ld", &seconds) != 1) seconds = 0; fclose(file); }
  time->tv_sec += seconds;
  return code;
}
"#;

/// The time of day of processes, which a test moves.
#[derive(Debug)]
pub struct Wall {
    folder: tempfile::TempDir,
    library: PathBuf,
}

impl Wall {
    #[allow(clippy::new_without_default, reason = "it builds a library")]
    /// Builds the shim with the C compiler that the workspace needs anyway.
    pub fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let (source, library) = (folder.path().join("shim.c"), folder.path().join("shim.so"));
        std::fs::write(&source, SHIM).expect("the source");
        let built = Command::new("cc").args(["-shared", "-fPIC", "-o"]).args([&library, &source]).arg("-ldl").status();
        assert!(built.expect("a C compiler").success());
        Self { folder, library }
    }

    /// A path beside the shim.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Moves the time of day of every process that runs with [`Self::environment`].
    pub fn set(&self, seconds: i64) {
        std::fs::write(self.path("new"), seconds.to_string()).expect("the clock");
        std::fs::rename(self.path("new"), self.path("clock")).expect("the clock");
    }

    /// The variables with which a process sees this time of day.
    pub fn environment(&self) -> [(String, PathBuf); 2] {
        [("LD_PRELOAD".to_owned(), self.library.clone()), ("TEST_CLOCK".to_owned(), self.path("clock"))]
    }

    /// The offset that makes this moment 1970.
    pub fn boot_without_battery() -> i64 {
        #[allow(clippy::disallowed_methods, reason = "the time of day is what this test is about")]
        let now = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970");
        100 - now.as_secs() as i64
    }
}
