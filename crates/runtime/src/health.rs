//! Health of a service: NOT_SERVING until the service is ready, and again while it drains. [`probe`] is the client.

pub mod probe;

use tonic::server::NamedService;
use tonic_health::ServingStatus;
use tonic_health::pb::health_server::{Health as HealthApi, HealthServer};
use tonic_health::server::{HealthReporter, health_reporter};

/// Sets the health of one service and of the whole process (the empty service name) together.
#[derive(Debug, Clone)]
pub struct Health {
    reporter: HealthReporter,
    name: &'static str,
}

impl Health {
    /// Starts as NOT_SERVING. The second value is the gRPC service to add to a router.
    pub async fn new<S: NamedService>() -> (Self, HealthServer<impl HealthApi>) {
        let (reporter, server) = health_reporter();
        let health = Self { reporter, name: S::NAME };
        health.set(false).await;
        (health, server)
    }

    /// Sets a part of the service's health that has a name of its own. It does not change that of the service: a service that
    /// orchestrators take out of use cannot recover.
    pub async fn set_part(&self, name: &'static str, serving: bool) {
        let status = if serving { ServingStatus::Serving } else { ServingStatus::NotServing };
        self.reporter.set_service_status(name, status).await;
    }

    /// Sets SERVING or NOT_SERVING.
    pub async fn set(&self, serving: bool) {
        let status = if serving { ServingStatus::Serving } else { ServingStatus::NotServing };
        self.reporter.set_service_status("", status).await;
        self.reporter.set_service_status(self.name, status).await;
    }
}
