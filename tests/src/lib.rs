//! magex-tests
