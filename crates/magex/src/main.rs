//! The `magex` command. See `magex --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    // Before anything else: this may replace the process.
    if let Err(error) = magex_runtime::process::ensure_environment() {
        return magex::cli::cannot_start(&error);
    }
    magex::cli::main()
}
