use super::*;
use crate::net::in_flight::InFlightLimits;
use http_body::Body as _;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::codegen::Bytes;

/// A body of the chunks that are sent to it.
struct Chunks(mpsc::UnboundedReceiver<Bytes>);

impl http_body::Body for Chunks {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.0.poll_recv(cx).map(|chunk| chunk.map(|bytes| Ok(Frame::data(bytes))))
    }
}

fn metered(kind: CallKind, strict: bool) -> (mpsc::UnboundedSender<Bytes>, Metered) {
    let limits = InFlightLimits { calls: 1, streams: 1, caller_bytes: 1 << 20, bytes: 1 << 20 };
    let in_flight = InFlight::new(limits, CancellationToken::new());
    let permit = in_flight.acquire(&Caller { name: "a".into(), role: Role::Client }, kind).unwrap();
    let (chunks, receiver) = mpsc::unbounded_channel();
    (
        chunks,
        Metered::new(
            Body::new(Chunks(receiver)),
            Arc::new(permit),
            kind,
            Limit { bytes: 100, remedy: strict.then_some("shorter") },
            None,
        ),
    )
}

async fn next(body: &mut Metered) -> Option<Result<Frame<Bytes>, Status>> {
    std::future::poll_fn(|cx| Pin::new(&mut *body).poll_frame(cx)).await
}

fn message(length: u8) -> Vec<u8> {
    [&[0, 0, 0, 0, length][..], &vec![7; length as usize]].concat()
}

#[tokio::test]
async fn every_message_of_a_stream_has_its_own_timeout() {
    let (_chunks, mut body) = metered(CallKind::Stream, false);
    let begin = |body: &mut Metered| body.timeout = Some(Box::pin(tokio::time::sleep(MESSAGE)));
    let (first, second) = (message(8), message(8));
    body.count(&first[..9]).unwrap();
    assert!(body.timed);
    begin(&mut body);
    body.count(&first[9..11]).unwrap();
    assert!(body.timed && body.timeout.is_some(), "more of the same message does not extend the timeout");
    // The next message begins at once.
    body.count(&[&first[11..], &second[..9]].concat()).unwrap();
    assert!(body.timed && body.timeout.is_none());
    begin(&mut body);
    body.count(&[&second[9..], &message(0)[..], &message(0)[..3]].concat()).unwrap();
    assert!(body.timed && body.timeout.is_none());
    begin(&mut body);
    body.count(&message(0)[3..]).unwrap();
    assert!(!body.timed && body.timeout.is_none(), "a stream may be silent between messages");
}

#[tokio::test]
async fn an_unfinished_message_times_out() {
    for kind in [CallKind::Stream, CallKind::Call] {
        let (chunks, mut body) = metered(kind, false);
        chunks.send(Bytes::copy_from_slice(&message(8)[..9])).unwrap();
        next(&mut body).await.unwrap().unwrap();
        body.timeout = Some(Box::pin(tokio::time::sleep(std::time::Duration::from_millis(20))));
        let error = next(&mut body).await.unwrap().unwrap_err();
        assert_eq!(error.code(), tonic::Code::DeadlineExceeded, "{error}");
    }
}

#[tokio::test]
async fn anonymous_callers_send_short_messages_only() {
    for (strict, refused) in [(true, true), (false, false)] {
        let (chunks, mut body) = metered(CallKind::Call, strict);
        chunks.send(message(101).into()).unwrap();
        assert_eq!(next(&mut body).await.unwrap().is_err(), refused);
    }
}

/// Never answers.
#[derive(Clone)]
struct Mute;

impl Service<http::Request<Body>> for Mute {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = std::future::Pending<Result<http::Response<Body>, Infallible>>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, _: http::Request<Body>) -> Self::Future {
        std::future::pending()
    }
}

#[tokio::test]
async fn anonymous_callers_hold_a_bounded_number_of_calls() {
    let (incoming, _) = crate::server::bind("127.0.0.1:0").await.unwrap();
    let mut public = Guard::public(Mute, incoming.connections());
    let mut held = Vec::new();
    let refused = loop {
        let mut answer = public.call(http::Request::builder().uri("/s/Watch").body(Body::empty()).unwrap());
        match std::future::poll_fn(|cx| Poll::Ready(answer.as_mut().poll(cx))).await {
            Poll::Pending => held.push(answer),
            Poll::Ready(Ok(response)) => break Status::from_header_map(response.headers()).unwrap(),
            Poll::Ready(Err(never)) => match never {},
        }
        assert!(held.len() < 10_000);
    };
    assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
    // Unary calls have a limit of their own.
    let mut other = public.call(http::Request::builder().uri("/s/Check").body(Body::empty()).unwrap());
    assert!(std::future::poll_fn(|cx| Poll::Ready(other.as_mut().poll(cx))).await.is_pending());
}

#[tokio::test]
async fn of_a_compressed_message_the_length_that_comes_out_counts() {
    use std::io::Write as _;
    let packed = |length: usize| {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
        encoder.write_all(&vec![0; length]).unwrap();
        let bytes = encoder.finish().unwrap();
        Bytes::from([&[1][..], &(bytes.len() as u32).to_be_bytes(), &bytes].concat())
    };
    for (limit, length, code) in [
        (100, 100, None),
        (100, 101, Some(tonic::Code::OutOfRange)),
        // Within the limit of a message, and beyond that of the caller.
        (4 << 20, 2 << 20, Some(tonic::Code::ResourceExhausted)),
    ] {
        let (chunks, mut body) = metered(CallKind::Call, false);
        (body.encoding, body.limit.bytes) = (Some(Encoding::Gzip), limit);
        for chunk in packed(length).chunks(11) {
            chunks.send(Bytes::copy_from_slice(chunk)).unwrap();
        }
        drop(chunks);
        let (mut plain, mut refused) = (Vec::new(), None);
        while let Some(frame) = next(&mut body).await {
            match frame {
                Ok(frame) => plain.extend_from_slice(frame.data_ref().unwrap()),
                Err(status) => {
                    refused = Some(status.code());
                    break;
                }
            }
        }
        assert_eq!(refused, code, "{length} of {limit}");
        assert!(
            code.is_some()
                || plain == message(length as u8).iter().map(|b| if *b == 7 { 0 } else { *b }).collect::<Vec<_>>()
        );
    }
}
