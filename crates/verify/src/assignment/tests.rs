use super::*;
use crate::Refusal;

fn verify_assignment(text: &str) -> Result<Report, Refusal> {
    crate::compare(text, &mut String::new())
}

const SUBSET: &str = include_str!("../../testdata/assignment/dev-subset.json");

#[test]
fn the_recorded_problems_agree() {
    let report = verify_assignment(SUBSET).unwrap();
    assert!(report.agrees(), "{:?}", report.mismatches);
    assert!(report.worst("relative cost") <= 1e-12, "{report:?}");
    let unique = report.content.strip_prefix("107 problems, ").and_then(|rest| rest.split(' ').next());
    assert!(unique.unwrap().parse::<u32>().unwrap() > 50, "{}", report.content);
}

#[test]
fn malformed_recordings_are_refused_by_field() {
    let case = r#"{"name":"a","rows":1,"cols":2,"row_ind":[0],"col_ind":[1],"cost":1,"unique":true,"matrix":[2,1]}"#;
    let file = |case: &str| format!(r#"{{"format":"assignment-golden-1","meta":{{}},"cases":[{case}]}}"#);
    assert!(verify_assignment(&file(case)).unwrap().agrees());
    for (from, to, field) in [
        ("\"rows\":1", "\"rows\":0", "cases[0].rows"),
        ("\"cols\":2", "\"cols\":\"2\"", "cases[0].cols"),
        ("[2,1]", "[2,null]", "cases[0].matrix[1]"),
        ("[2,1]", "[2]", "cases[0].matrix"),
        ("\"matrix\":[2,1]", "\"agents\":[[0,0]]", "cases[0].matrix"),
        ("\"matrix\":[2,1]", "\"agents\":[[0,0]],\"goals\":[[0,0],[1]]", "cases[0].goals[1]"),
        ("\"col_ind\":[1]", "\"col_ind\":[2]", "cases[0].col_ind[0]"),
        ("\"col_ind\":[1]", "\"col_ind\":[]", "cases[0].col_ind"),
        ("\"cost\":1", "\"cost\":null", "cases[0].cost"),
        ("\"unique\":true", "\"unique\":1", "cases[0].unique"),
    ] {
        assert!(case.contains(from));
        let error = verify_assignment(&file(&case.replace(from, to))).unwrap_err();
        assert!(error.to_string().starts_with(&format!("{field}: ")), "{error}");
    }
    let empty = file("");
    for (text, start) in [
        ("{", "recording: not valid JSON"),
        ("[]", "recording: must be an object"),
        ("{}", "format: is missing"),
        (r#"{"format":"x"}"#, "format x is not supported by this version"),
        (&empty, "cases: is empty"),
    ] {
        let error = verify_assignment(text).unwrap_err().to_string();
        assert!(error.starts_with(start), "{error}");
    }
}

#[test]
fn a_wrong_recording_is_a_mismatch_and_not_an_error() {
    let wrong = SUBSET.replace(r#""cost":3.5792"#, r#""cost":3.5793"#);
    let report = verify_assignment(&wrong).unwrap();
    assert!(!report.agrees());
    assert_eq!(report.mismatches.len(), 1);
    assert!(report.mismatches[0].starts_with("tiny_1x1: cost "), "{:?}", report.mismatches);
    assert!(report.worst("relative cost") > 1e-6);
}
