//! The `magex` command. See `magex --help`.

use std::process::ExitCode;

// An update asks for thousands of small tensors in a second; from two threads at once the C library is slower.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    // Before anything else: this may replace the process.
    if let Err(error) = magex_runtime::process::ensure_environment() {
        return magex::cli::cannot_start(&error);
    }
    magex::cli::main()
}
