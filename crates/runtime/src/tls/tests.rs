use super::*;
use crate::exit::USAGE;

/// A certificate of `name` with its key, in files; good until the end of `year`.
pub(crate) fn made(folder: &Path, name: &str, year: i32) -> (PathBuf, PathBuf) {
    let mut params = rcgen::CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
    params.not_after = rcgen::date_time_ymd(year, 1, 1);
    let key = rcgen::KeyPair::generate().unwrap();
    let (certificate_file, key_file) = (folder.join(format!("{name}.pem")), folder.join(format!("{name}.key")));
    std::fs::write(&certificate_file, params.self_signed(&key).unwrap().pem()).unwrap();
    std::fs::write(&key_file, key.serialize_pem()).unwrap();
    (certificate_file, key_file)
}

#[test]
fn every_wrong_file_is_named_with_what_is_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let (one, one_key) = made(folder.path(), "one", 2100);
    let (_, two_key) = made(folder.path(), "two", 2100);
    let file = |name: &str, content: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    };
    let encrypted = file("enc", b"-----BEGIN ENCRYPTED PRIVATE KEY-----\nMIIB\n-----END ENCRYPTED PRIVATE KEY-----\n");
    let old = file("old", b"-----BEGIN EC PRIVATE KEY-----\nProc-Type: 4,ENCRYPTED\nDEK-Info: AES-256-CBC,00\n\nMIIB\n-----END EC PRIVATE KEY-----\n");
    let request = file("csr", b"-----BEGIN CERTIFICATE REQUEST-----\nMIIB\n-----END CERTIFICATE REQUEST-----\n");
    let (der, text, empty) = (file("der", &[0x30, 0x82, 1, 2]), file("text", b"hello"), file("empty", b""));
    let damaged = file("damaged", b"-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n");
    let (gone, dir) = (folder.path().join("gone"), folder.path().to_owned());
    for (certificate, key, ca, option, words) in [
        (&one, &two_key, None, "--tls-key", "does not belong to the first certificate in"),
        (
            &one,
            &encrypted,
            None,
            "--tls-key",
            "encrypted; a service cannot ask for its passphrase; decrypt it with openssl",
        ),
        (&one, &old, None, "--tls-key", "encrypted"),
        (&one_key, &one, None, "--tls-cert", "exchanged?"),
        (&one, &one, None, "--tls-key", "holds a certificate and no private key"),
        (&request, &one_key, None, "--tls-cert", "certificate request, not yet signed"),
        (&der, &one_key, None, "--tls-cert", "DER, not PEM"),
        (&text, &one_key, None, "--tls-cert", "not PEM"),
        (&one, &text, None, "--tls-key", "not PEM"),
        (&empty, &one_key, None, "--tls-cert", "empty"),
        (&one, &empty, None, "--tls-key", "empty"),
        (&damaged, &one_key, None, "--tls-cert", "damaged"),
        (&gone, &one_key, None, "--tls-cert", "No such file"),
        (&one, &dir, None, "--tls-key", "a folder"),
        (&one, &one_key, Some(&one_key), "--client-ca", "a certificate (PEM) belongs here"),
        (&one, &one_key, Some(&gone), "--client-ca", "No such file"),
    ] {
        let error = ServerTls::read(certificate, key, ca.map(PathBuf::as_path)).unwrap_err();
        assert_eq!(error.code, USAGE);
        assert!(error.message.starts_with(option) && error.message.contains(words), "{error}");
    }
    let error = ClientTls::read(&two_key, None, None).unwrap_err();
    assert!(error.message.starts_with("--tls-ca") && error.message.contains("private key"), "{error}");
    let error = ClientTls::read(&one, Some(&one), Some(&two_key)).unwrap_err();
    assert!(error.message.starts_with("--tls-key"), "{error}");
}

#[test]
fn files_are_read_again_as_a_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let (certificate, key) = made(folder.path(), "own", 2100);
    let tls = ServerTls::read(&certificate, &key, None).unwrap();
    let (first, end) = (tls.config(), tls.ends()[0].1);
    // 2100-01-01
    assert_eq!(end.as_secs(), 4_102_444_800);
    let (newer, newer_key) = made(folder.path(), "newer", 2200);
    std::fs::copy(&newer, &certificate).unwrap();
    let error = tls.reload().unwrap_err();
    assert!(error.message.contains("does not belong"), "{error}");
    assert!(Arc::ptr_eq(&first, &tls.config()) && tls.ends()[0].1 == end, "the old pair stays");
    std::fs::copy(&newer_key, &key).unwrap();
    tls.reload().unwrap();
    assert!(!Arc::ptr_eq(&first, &tls.config()) && tls.ends()[0].1 > end);
    assert!(!format!("{tls:?}").contains("KEY"));
}
