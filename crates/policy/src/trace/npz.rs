//! NumPy's archive: a zip file of arrays, stored as they are.

use super::{Numbers, Trace};

/// The arrays of all steps, [T, N, …] each, and `about`, JSON as bytes.
pub fn write(trace: &Trace) -> Vec<u8> {
    let mut files = Vec::new();
    let names: Vec<&str> =
        trace.steps.first().map(|step| step.arrays.iter().map(|(name, ..)| *name).collect()).unwrap_or_default();
    for (k, name) in names.into_iter().enumerate() {
        let (mut data, mut descr, mut inner) = (Vec::new(), "|u1", Vec::new());
        for step in &trace.steps {
            let (_, shape, numbers) = &step.arrays[k];
            inner.clone_from(shape);
            match numbers {
                Numbers::Floats(values) => {
                    descr = "<f4";
                    data.extend(values.iter().flat_map(|x| x.to_le_bytes()));
                }
                Numbers::Bytes(values) => data.extend(values),
            }
        }
        let shape = [&[trace.steps.len(), trace.agents], inner.as_slice()].concat();
        files.push((format!("{name}.npy"), array(descr, &shape, &data)));
    }
    let about = serde_json::to_vec(&trace.about).unwrap_or_default();
    files.push(("about.npy".to_owned(), array("|u1", &[about.len()], &about)));
    zip(&files)
}

/// Version 1.0 of the format of single arrays.
fn array(descr: &str, shape: &[usize], data: &[u8]) -> Vec<u8> {
    let shape: String = shape.iter().map(|size| format!("{size}, ")).collect();
    let mut head = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}");
    // The data begins at a multiple of 64.
    while (10 + head.len() + 1) % 64 != 0 {
        head.push(' ');
    }
    head.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((head.len() as u16).to_le_bytes());
    bytes.extend(head.as_bytes());
    bytes.extend(data);
    bytes
}

/// A zip archive without compression.
fn zip(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let (mut bytes, mut directory) = (Vec::new(), Vec::new());
    for (name, data) in files {
        let offset = bytes.len() as u32;
        // Version 2.0, no flags, stored, 1 January 1980.
        let mut common = Vec::new();
        for half in [20u16, 0, 0, 0, 0x21] {
            common.extend(half.to_le_bytes());
        }
        for word in [crc32(data), data.len() as u32, data.len() as u32] {
            common.extend(word.to_le_bytes());
        }
        common.extend((name.len() as u16).to_le_bytes());
        common.extend([0, 0]);
        bytes.extend(b"PK\x03\x04");
        bytes.extend(&common);
        bytes.extend(name.as_bytes());
        bytes.extend(data);
        directory.extend(b"PK\x01\x02\x14\x00");
        directory.extend(&common);
        directory.extend([0; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let (start, count) = (bytes.len() as u32, files.len() as u16);
    bytes.extend(&directory);
    bytes.extend(b"PK\x05\x06\x00\x00\x00\x00");
    bytes.extend(count.to_le_bytes());
    bytes.extend(count.to_le_bytes());
    bytes.extend((directory.len() as u32).to_le_bytes());
    bytes.extend(start.to_le_bytes());
    bytes.extend([0, 0]);
    bytes
}

/// The checksum of zip archives (polynomial 0xEDB88320).
pub(super) fn crc32(bytes: &[u8]) -> u32 {
    let mut table = [0u32; 256];
    for (k, slot) in (0u32..).zip(&mut table) {
        *slot = (0..8).fold(k, |c, _| if c & 1 > 0 { 0xEDB8_8320 ^ (c >> 1) } else { c >> 1 });
    }
    !bytes.iter().fold(!0u32, |crc, &byte| table[((crc ^ u32::from(byte)) & 0xFF) as usize] ^ (crc >> 8))
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_checksum_is_the_known_one() {
        assert_eq!(super::crc32(b"123456789"), 0xCBF4_3926);
    }
}
