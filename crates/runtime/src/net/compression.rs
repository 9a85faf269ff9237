//! Compressed messages (gzip, deflate), in both directions and for every service.
//!
//! A request's messages are decompressed here, in front of the service and while they arrive: so every limit (of a message, of
//! a caller's bytes in flight) counts what comes out, and a message that would become too long is refused as soon as it does.
//! A response is compressed if its caller accepts that, except for short messages, which would hardly become shorter.

use flate2::Compression;
use flate2::write::{GzDecoder, GzEncoder, ZlibDecoder, ZlibEncoder};
use std::fmt;
use std::io::{Error, ErrorKind, Write};
use tonic::codegen::Bytes;
use tonic::codegen::http::{HeaderMap, HeaderValue};
use tonic::{Code, Status};

/// Bytes before every message: a compression flag and the length.
pub(super) const PREFIX: usize = 5;
/// Shorter messages of responses are not compressed, bytes.
const SHORT: usize = 1024;
/// What a response offers, and the status that rejects an unknown one.
const OFFERED: &str = "gzip,deflate,identity";
const ENCODING: &str = "grpc-encoding";
const ACCEPTED: &str = "grpc-accept-encoding";

/// A compression of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Gzip,
    Deflate,
}

impl Encoding {
    fn of(name: &str) -> Option<Self> {
        match name.trim() {
            "gzip" => Some(Self::Gzip),
            "deflate" => Some(Self::Deflate),
            _ => None,
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Gzip => "gzip",
            Self::Deflate => "deflate",
        }
    }

    /// The compression of a request's messages. Its header is removed: behind this, nothing is compressed.
    pub(super) fn of_request(headers: &mut HeaderMap) -> Result<Option<Self>, Status> {
        let Some(value) = headers.get(ENCODING) else { return Ok(None) };
        let name = value.to_str().unwrap_or("?").to_owned();
        let encoding = Self::of(&name);
        if encoding.is_none() && name != "identity" {
            let problem = format!("{ENCODING}: '{name}' is not supported; use one of {OFFERED}");
            let mut status = Status::new(Code::Unimplemented, problem);
            status.metadata_mut().insert(ACCEPTED, tonic::metadata::MetadataValue::from_static(OFFERED));
            return Err(status);
        }
        headers.remove(ENCODING);
        Ok(encoding)
    }

    /// The first compression that the caller accepts.
    pub(super) fn for_response(headers: &HeaderMap) -> Option<Self> {
        headers.get(ACCEPTED)?.to_str().ok()?.split(',').find_map(Self::of)
    }

    /// Announces what is accepted here, and with which compression the response comes.
    pub(super) fn announce(encoding: Option<Self>, headers: &mut HeaderMap) {
        headers.insert(ACCEPTED, HeaderValue::from_static(OFFERED));
        if let Some(encoding) = encoding {
            headers.insert(ENCODING, HeaderValue::from_static(encoding.name()));
        }
    }

    /// Compresses the messages of a frame of a response: tonic's frames hold whole messages, not compressed ones.
    pub(super) fn compress(self, frame: Bytes) -> Bytes {
        let mut packed = Vec::with_capacity(frame.len() / 2);
        let mut rest = &frame[..];
        while let Some((message, after)) = split(rest) {
            rest = after;
            let body = &message[PREFIX..];
            if body.len() < SHORT || message[0] != 0 || self.append(body, &mut packed).is_err() {
                packed.extend_from_slice(message);
            }
        }
        // Not whole messages after all: as it came.
        if rest.is_empty() { packed.into() } else { frame }
    }

    /// Appends a compressed message. Speed matters more than the last bytes: clients wait for the answer.
    fn append(self, body: &[u8], packed: &mut Vec<u8>) -> Result<(), Error> {
        let start = packed.len();
        packed.extend_from_slice(&[1, 0, 0, 0, 0]);
        match self {
            Self::Gzip => {
                let mut encoder = GzEncoder::new(&mut *packed, Compression::fast());
                encoder.write_all(body)?;
                encoder.finish()?;
            }
            Self::Deflate => {
                let mut encoder = ZlibEncoder::new(&mut *packed, Compression::fast());
                encoder.write_all(body)?;
                encoder.finish()?;
            }
        }
        let length = (packed.len() - start - PREFIX) as u32;
        packed[start + 1..start + PREFIX].copy_from_slice(&length.to_be_bytes());
        Ok(())
    }
}

/// The first message of a frame, with its prefix, and the rest.
fn split(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let length = bytes.get(1..PREFIX)?.try_into().ok().map(u32::from_be_bytes)? as usize;
    bytes.split_at_checked(PREFIX + length)
}

/// The message that comes out, up to a length.
struct Limited {
    bytes: Vec<u8>,
    limit: usize,
}

impl Write for Limited {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Error> {
        if self.bytes.len() + bytes.len() > PREFIX + self.limit {
            return Err(Error::from(ErrorKind::FileTooLarge));
        }
        self.bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Error> {
        Ok(())
    }
}

enum Decoder {
    Gzip(GzDecoder<Limited>),
    Deflate(ZlibDecoder<Limited>),
}

/// A compressed message that arrives.
pub(super) struct Inflating {
    decoder: Decoder,
    limit: usize,
}

impl fmt::Debug for Inflating {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Inflating").field("limit", &self.limit).finish_non_exhaustive()
    }
}

impl Inflating {
    /// A message of at most `limit` bytes comes out.
    pub(super) fn new(encoding: Encoding, limit: usize) -> Self {
        let out = Limited { bytes: vec![0; PREFIX], limit };
        let decoder = match encoding {
            Encoding::Gzip => Decoder::Gzip(GzDecoder::new(out)),
            Encoding::Deflate => Decoder::Deflate(ZlibDecoder::new(out)),
        };
        Self { decoder, limit }
    }

    /// Takes the next bytes. Returns the length of what has come out so far.
    pub(super) fn push(&mut self, bytes: &[u8]) -> Result<usize, Status> {
        let (written, out) = match &mut self.decoder {
            Decoder::Gzip(decoder) => (decoder.write_all(bytes), decoder.get_ref()),
            Decoder::Deflate(decoder) => (decoder.write_all(bytes), decoder.get_ref()),
        };
        let length = out.bytes.len() - PREFIX;
        written.map(|()| length).map_err(|error| self.problem(&error))
    }

    /// The end of the message: the whole, with its prefix, not compressed.
    pub(super) fn finish(self) -> Result<Bytes, Status> {
        let limit = self.limit;
        let out = match self.decoder {
            Decoder::Gzip(decoder) => decoder.finish(),
            Decoder::Deflate(decoder) => decoder.finish(),
        };
        let mut bytes = out.map_err(|error| problem(&error, limit))?.bytes;
        let length = (bytes.len() - PREFIX) as u32;
        bytes[1..PREFIX].copy_from_slice(&length.to_be_bytes());
        Ok(bytes.into())
    }

    fn problem(&self, error: &Error) -> Status {
        problem(error, self.limit)
    }
}

fn problem(error: &Error, limit: usize) -> Status {
    match error.kind() {
        ErrorKind::FileTooLarge => {
            Status::out_of_range(format!("a compressed message becomes longer than the limit of {limit} bytes"))
        }
        _ => Status::invalid_argument(format!("the compressed message is damaged or not complete: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packed(encoding: Encoding, body: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        encoding.append(body, &mut bytes).unwrap();
        bytes
    }

    fn unpack(encoding: Encoding, bytes: &[u8], limit: usize) -> Result<Bytes, Status> {
        let mut inflating = Inflating::new(encoding, limit);
        // However it is cut.
        bytes.chunks(7).try_for_each(|part| inflating.push(part).map(drop))?;
        inflating.finish()
    }

    #[test]
    fn messages_survive_and_longer_ones_than_the_limit_are_refused_early() {
        let body: Vec<u8> = (0..5000u32).flat_map(|k| (k * 7).to_le_bytes()).collect();
        for encoding in [Encoding::Gzip, Encoding::Deflate] {
            let bytes = packed(encoding, &body);
            let whole = unpack(encoding, &bytes[PREFIX..], body.len()).unwrap();
            assert_eq!((&whole[..PREFIX], &whole[PREFIX..]), (&[0, 0, 0, 78, 32][..], &body[..]));
            assert_eq!(unpack(encoding, &bytes[PREFIX..], body.len() - 1).unwrap_err().code(), Code::OutOfRange);
            let cut = &bytes[PREFIX..bytes.len() - 9];
            assert_eq!(unpack(encoding, cut, body.len()).unwrap_err().code(), Code::InvalidArgument);
            assert_eq!(unpack(encoding, b"not compressed", 100).unwrap_err().code(), Code::InvalidArgument);
        }
        // A megabyte of zeros takes a kilobyte; the limit stops it with little memory.
        let zeros = packed(Encoding::Gzip, &vec![0; 1 << 20]);
        let mut inflating = Inflating::new(Encoding::Gzip, 1000);
        assert_eq!(inflating.push(&zeros[PREFIX..]).unwrap_err().code(), Code::OutOfRange);
        let Decoder::Gzip(decoder) = &inflating.decoder else { panic!("gzip") };
        assert!(decoder.get_ref().bytes.capacity() < 100_000, "{}", decoder.get_ref().bytes.capacity());
    }

    #[test]
    fn long_messages_of_a_response_are_compressed_and_short_ones_are_not() {
        let message = |length: usize| [&[0][..], &(length as u32).to_be_bytes(), &vec![7; length]].concat();
        let frame: Bytes = [message(3), message(5000)].concat().into();
        let out = Encoding::Gzip.compress(frame);
        assert_eq!(out[..8], message(3));
        assert!(out[8] == 1 && out.len() < 200, "{}", out.len());
        assert_eq!(unpack(Encoding::Gzip, &out[8 + PREFIX..], 5000).unwrap(), message(5000));
        let odd = Bytes::from_static(b"\0\0\0\0\x09abc");
        assert_eq!(Encoding::Gzip.compress(odd.clone()), odd);
    }

    #[test]
    fn unknown_compressions_are_refused_with_those_that_are_known() {
        let headers =
            |name: &'static str| HeaderMap::from_iter([(ENCODING.parse().unwrap(), HeaderValue::from_static(name))]);
        let mut gzip = headers("gzip");
        assert_eq!(Encoding::of_request(&mut gzip).unwrap(), Some(Encoding::Gzip));
        assert!(gzip.is_empty());
        assert_eq!(Encoding::of_request(&mut headers("identity")).unwrap(), None);
        assert_eq!(Encoding::of_request(&mut HeaderMap::new()).unwrap(), None);
        let status = Encoding::of_request(&mut headers("snappy")).unwrap_err();
        assert!(status.code() == Code::Unimplemented && status.message().contains("'snappy'"), "{status}");
        assert_eq!(status.metadata().get(ACCEPTED).unwrap(), OFFERED);
    }
}
