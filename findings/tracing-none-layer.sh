#!/usr/bin/env bash
# tracing-subscriber 0.3.23 with tracing 0.1.44: a layer that is None, beside a layer whose filter is combined of two.
#
# Expected: a span that the only layer's filter refuses is disabled, as it is with either part alone.
# Seen: a combined filter without a level of its own (EnvFilter and filter_fn) loses the maximum level, and with a second layer that is
# None every refused span is made, entered, left and closed in the registry all the same. A gRPC server makes dozens of spans for a call
# in h2 and hyper: a service that exports traces on request, and is not asked to, answered 1.4 to 1.7 times as many calls per second
# once its filter was the subscriber's and the None layer was gone.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
mkdir src
cat > Cargo.toml <<'TOML'
[package]
name = "none-layer"
version = "0.1.0"
edition = "2024"
[dependencies]
tracing = "=0.1.44"
tracing-core = "=0.1.36"
tracing-subscriber = { version = "=0.3.23", features = ["env-filter"] }
[workspace]
TOML
cat > src/main.rs <<'RUST'
use tracing_subscriber::filter::{EnvFilter, FilterExt as _, Filtered, LevelFilter, filter_fn};
use tracing_subscriber::layer::{Layer as _, SubscriberExt as _};
use tracing_subscriber::{fmt, registry};

fn print(what: &str, subscriber: impl tracing::Subscriber + Send + Sync + 'static) {
    let _current = tracing::subscriber::set_default(subscriber);
    let made = tracing::trace_span!("of a library").id().is_some();
    println!("{what}: maximum level {}, refused span made: {made}", LevelFilter::current());
}

fn main() {
    macro_rules! absent {
        () => {
            None::<Filtered<fmt::Layer<_>, LevelFilter, _>>
        };
    }
    let both = || EnvFilter::new("info").and(filter_fn(|metadata| metadata.target() != "exported"));
    // One per process: a call site remembers what it was told first.
    match std::env::args().nth(1).as_deref() {
        Some("one") => print("one filter", registry().with(fmt::layer().with_filter(EnvFilter::new("info")))),
        Some("none") => {
            print("one filter, None beside", registry().with(fmt::layer().with_filter(EnvFilter::new("info"))).with(absent!()))
        }
        Some("two") => print("two filters", registry().with(fmt::layer().with_filter(both()))),
        _ => print("two filters, None beside", registry().with(fmt::layer().with_filter(both())).with(absent!())),
    }
}
RUST
cargo build --quiet
for kind in one none two both; do ./target/debug/none-layer "$kind"; done | tee seen
diff seen - <<'SEEN' && echo "as before"
one filter: maximum level info, refused span made: false
one filter, None beside: maximum level info, refused span made: false
two filters: maximum level trace, refused span made: false
two filters, None beside: maximum level trace, refused span made: true
SEEN
