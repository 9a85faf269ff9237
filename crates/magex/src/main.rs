//! The `magex` command. See `magex --help`.

use std::process::ExitCode;

/// Many short-lived buffers on several threads: the system's allocator gives their memory back too slowly.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    // Before anything else: this may replace the process.
    if let Err(error) = magex_runtime::process::ensure_single_threaded_math() {
        return magex::cli::cannot_start(&error);
    }
    magex::cli::main()
}
