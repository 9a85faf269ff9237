//! One trace from the lease to the update, over all processes; and no harm from a collector that is not there.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::ExecutorKind;
use magex_runtime::server;
use magex_tests::sandbox::{Cluster, options, wait_until};
use magex_tests::{small, train};
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use std::sync::{Arc, Mutex};
use tonic::{Request, Response, Status};

/// Keeps every span that it is sent, with the name of the service that sent it.
#[derive(Clone, Default)]
struct Collector {
    spans: Arc<Mutex<Vec<(String, Span)>>>,
}

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        for resource in request.into_inner().resource_spans {
            let attributes = resource.resource.unwrap().attributes;
            let name =
                attributes.iter().find(|a| a.key == "service.name").and_then(|a| a.value.as_ref()?.value.clone());
            let Some(Value::StringValue(service)) = name else { panic!("no service.name in {attributes:?}") };
            let spans = resource.scope_spans.into_iter().flat_map(|scope| scope.spans);
            self.spans.lock().unwrap().extend(spans.map(|span| (service.clone(), span)));
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

impl Collector {
    /// Iterations whose span has ended.
    fn iterations(&self) -> usize {
        let spans = self.spans.lock().unwrap();
        spans.iter().filter(|(service, span)| service == "magex-learner" && span.name == "iteration").count()
    }

    /// A trace in which every one of these spans, by service and name, has the parent that is named beside it.
    fn has_whole_trace(&self) -> bool {
        const TREE: [[&str; 3]; 10] = [
            ["magex-learner", "iteration", ""],
            ["magex-learner", "lease", "iteration"],
            ["magex-actor", "rollout", "lease"],
            ["magex-actor", "weights wait", "rollout"],
            ["magex-actor", "goals", "rollout"],
            ["magex-commander", "assign batch", "goals"],
            ["magex-actor", "upload", "rollout"],
            ["magex-learner", "ingest", "lease"],
            ["magex-learner", "update", "iteration"],
            ["magex-learner", "checkpoint", "iteration"],
        ];
        let spans = self.spans.lock().unwrap();
        let roots = spans.iter().filter(|(service, span)| service == "magex-learner" && span.name == "iteration");
        roots.into_iter().any(|(_, root)| {
            let of_it: Vec<_> = spans.iter().filter(|(_, span)| span.trace_id == root.trace_id).collect();
            TREE.iter().all(|[service, name, parent]| {
                of_it.iter().any(|(own, span)| {
                    let parents = of_it.iter().find(|(_, p)| p.span_id == span.parent_span_id);
                    own == service && span.name == *name && parents.map_or("", |(_, p)| p.name.as_str()) == *parent
                })
            })
        })
    }
}

#[test]
fn one_trace_goes_from_the_lease_to_the_update_through_every_process() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let collector = Collector::default();
    let (incoming, address) = runtime.block_on(server::bind("127.0.0.1:0")).unwrap();
    let service = TraceServiceServer::new(collector.clone());
    runtime.spawn(server::builder().add_service(service).serve_with_incoming(incoming));
    let config = small(ExecutorKind::Local, 5, 6);
    let mut cluster = Cluster::start_with(&config, options(&["--otlp", &format!("http://{address}")]));
    cluster.start_actor();
    let sha256 = cluster.finish();
    assert!(cluster.actors[0].wait().success());
    wait_until("a trace over all processes", || collector.has_whole_trace());
    // The closing one, too, whose span is the last thing that ends.
    wait_until("every iteration", || collector.iterations() == 7);
    // No log shows the spans.
    assert!(!cluster.learner.log().contains("magex_trace"), "{}", cluster.learner.log());
    assert_eq!(sha256, train(&config, tempfile::tempdir().unwrap().path(), 1, 1).sha256);
}

#[test]
fn a_collector_that_is_not_there_stops_no_process() {
    let config = small(ExecutorKind::Local, 5, 6);
    let mut cluster = Cluster::start_with(&config, options(&["--otlp", "http://127.0.0.1:9"]));
    cluster.start_actor();
    assert_eq!(cluster.finish(), train(&config, tempfile::tempdir().unwrap().path(), 1, 1).sha256);
    assert!(cluster.actors[0].wait().success());
}
