//! Writes a graph node by node. A value is the name of what a node puts out.

use super::proto::{
    Attribute, Dimension, FLOAT, Graph, INT64, Kind, Node, ShapeValue, TensorKind, TensorValue, ValueInfo,
};

/// The name of a value.
pub(super) type Value = String;

/// A graph that is being written.
#[derive(Debug, Default)]
pub(super) struct Builder {
    pub(super) graph: Graph,
    count: usize,
}

/// A size of an input or output.
#[derive(Debug, Clone, Copy)]
pub(super) enum Size<'a> {
    Fixed(usize),
    /// Every dimension of this name has this size.
    Named(&'a str),
}

fn number(name: &str, i: i64) -> Attribute {
    Attribute { name: name.into(), i: Some(i), kind: 2, ..Attribute::default() }
}

impl Builder {
    fn name(&mut self) -> String {
        self.count += 1;
        format!("v{}", self.count)
    }

    /// An input or output.
    fn info(name: &str, elem_type: i32, sizes: &[Size<'_>], doc: &str) -> ValueInfo {
        let dimension = |size: &Size<'_>| match size {
            Size::Fixed(value) => Dimension { value: Some(*value as i64), name: None },
            Size::Named(name) => Dimension { value: None, name: Some((*name).to_owned()) },
        };
        let shape = ShapeValue { dim: sizes.iter().map(dimension).collect() };
        let tensor = TensorKind { elem_type, shape: Some(shape) };
        ValueInfo { name: name.into(), kind: Some(Kind { tensor: Some(tensor) }), doc_string: doc.into() }
    }

    pub(super) fn input(&mut self, name: &str, sizes: &[Size<'_>], doc: &str) -> Value {
        self.graph.input.push(Self::info(name, FLOAT, sizes, doc));
        name.to_owned()
    }

    /// Names a value as an output.
    pub(super) fn output(&mut self, name: &str, value: &str, integers: bool, sizes: &[Size<'_>], doc: &str) {
        self.graph.output.push(Self::info(name, if integers { INT64 } else { FLOAT }, sizes, doc));
        self.node("Identity", &[value], vec![name.to_owned()], Vec::new());
    }

    fn node(&mut self, kind: &str, inputs: &[&str], output: Vec<String>, attribute: Vec<Attribute>) {
        let name = format!("{kind}_{}", self.graph.node.len());
        let input = inputs.iter().map(|&name| name.to_owned()).collect();
        self.graph.node.push(Node { input, output, name, op_type: kind.into(), attribute });
    }

    fn with(&mut self, kind: &str, inputs: &[&str], attributes: Vec<Attribute>) -> Value {
        let out = self.name();
        self.node(kind, inputs, vec![out.clone()], attributes);
        out
    }

    /// A node without attributes.
    pub(super) fn op(&mut self, kind: &str, inputs: &[&str]) -> Value {
        self.with(kind, inputs, Vec::new())
    }

    /// A constant with a name.
    pub(super) fn tensor(&mut self, name: &str, dims: &[usize], values: &[f32]) -> Value {
        if !self.graph.initializer.iter().any(|tensor| tensor.name == name) {
            self.graph.initializer.push(TensorValue {
                dims: dims.iter().map(|&size| size as i64).collect(),
                data_type: FLOAT,
                name: name.into(),
                raw_data: values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            });
        }
        name.to_owned()
    }

    /// A constant.
    pub(super) fn floats(&mut self, dims: &[usize], values: &[f32]) -> Value {
        let name = format!("c{}", self.name());
        self.tensor(&name, dims, values)
    }

    pub(super) fn scalar(&mut self, value: f32) -> Value {
        let name = format!("x{:08x}", value.to_bits());
        self.tensor(&name, &[], &[value])
    }

    pub(super) fn ints(&mut self, dims: &[usize], values: &[i64]) -> Value {
        let name = format!("i{dims:?}{values:?}").replace([' ', ','], "_");
        if !self.graph.initializer.iter().any(|tensor| tensor.name == name) {
            self.graph.initializer.push(TensorValue {
                dims: dims.iter().map(|&size| size as i64).collect(),
                data_type: INT64,
                name: name.clone(),
                raw_data: values.iter().flat_map(|x| x.to_le_bytes()).collect(),
            });
        }
        name
    }

    pub(super) fn add(&mut self, a: &str, b: &str) -> Value {
        self.op("Add", &[a, b])
    }

    pub(super) fn sub(&mut self, a: &str, b: &str) -> Value {
        self.op("Sub", &[a, b])
    }

    pub(super) fn mul(&mut self, a: &str, b: &str) -> Value {
        self.op("Mul", &[a, b])
    }

    pub(super) fn div(&mut self, a: &str, b: &str) -> Value {
        self.op("Div", &[a, b])
    }

    pub(super) fn matmul(&mut self, a: &str, b: &str) -> Value {
        self.op("MatMul", &[a, b])
    }

    pub(super) fn relu(&mut self, x: &str) -> Value {
        self.op("Relu", &[x])
    }

    pub(super) fn tanh(&mut self, x: &str) -> Value {
        self.op("Tanh", &[x])
    }

    pub(super) fn times(&mut self, x: &str, factor: f32) -> Value {
        let factor = self.scalar(factor);
        self.mul(x, &factor)
    }

    pub(super) fn over(&mut self, x: &str, divisor: f32) -> Value {
        let divisor = self.scalar(divisor);
        self.div(x, &divisor)
    }

    pub(super) fn at_least(&mut self, x: &str, least: f32) -> Value {
        let least = self.scalar(least);
        self.op("Max", &[x, &least])
    }

    pub(super) fn at_most(&mut self, x: &str, most: f32) -> Value {
        let most = self.scalar(most);
        self.op("Min", &[x, &most])
    }

    pub(super) fn clip(&mut self, x: &str, low: f32, high: f32) -> Value {
        let x = self.at_least(x, low);
        self.at_most(&x, high)
    }

    pub(super) fn concat(&mut self, axis: i64, parts: &[&str]) -> Value {
        match parts {
            [one] => (*one).to_owned(),
            parts => self.with("Concat", parts, vec![number("axis", axis)]),
        }
    }

    /// Parts of the given sizes along the last axis.
    pub(super) fn split(&mut self, x: &str, sizes: &[usize]) -> Vec<Value> {
        if sizes.len() == 1 {
            return vec![x.to_owned()];
        }
        let lengths: Vec<i64> = sizes.iter().map(|&size| size as i64).collect();
        let lengths = self.ints(&[sizes.len()], &lengths);
        let outputs: Vec<Value> = sizes.iter().map(|_| self.name()).collect();
        self.node("Split", &[x, &lengths], outputs.clone(), vec![number("axis", -1)]);
        outputs
    }

    pub(super) fn sum(&mut self, x: &str, axis: i64, keep: bool) -> Value {
        let axes = self.ints(&[1], &[axis]);
        self.with("ReduceSum", &[x, &axes], vec![number("keepdims", i64::from(keep))])
    }

    pub(super) fn unsqueeze(&mut self, x: &str, axis: i64) -> Value {
        let axes = self.ints(&[1], &[axis]);
        self.op("Unsqueeze", &[x, &axes])
    }

    pub(super) fn squeeze(&mut self, x: &str, axis: i64) -> Value {
        let axes = self.ints(&[1], &[axis]);
        self.op("Squeeze", &[x, &axes])
    }

    /// 0 keeps a size, −1 takes what is left.
    pub(super) fn reshape(&mut self, x: &str, shape: &[i64]) -> Value {
        let shape = self.ints(&[shape.len()], shape);
        self.op("Reshape", &[x, &shape])
    }

    pub(super) fn transpose(&mut self, x: &str, order: &[i64]) -> Value {
        let order = Attribute { name: "perm".into(), ints: order.to_vec(), kind: 7, ..Attribute::default() };
        self.with("Transpose", &[x], vec![order])
    }

    /// Rows by constant indices along an axis.
    pub(super) fn gather(&mut self, x: &str, indices: &str, axis: i64) -> Value {
        self.with("Gather", &[x, indices], vec![number("axis", axis)])
    }

    /// Rows [.., k, D] of x [.., M, D] by indices [.., k]; the first `batch` sizes are common.
    pub(super) fn pick(&mut self, x: &str, indices: &str, batch: i64) -> Value {
        let indices = self.unsqueeze(indices, -1);
        self.with("GatherND", &[x, &indices], vec![number("batch_dims", batch)])
    }

    /// The `count` smallest numbers along the last axis, smallest first, and their indices; the lower index first of equals.
    pub(super) fn smallest(&mut self, x: &str, count: usize) -> (Value, Value) {
        let count = self.ints(&[1], &[count as i64]);
        let (values, indices) = (self.name(), self.name());
        let attributes = vec![number("axis", -1), number("largest", 0), number("sorted", 1)];
        self.node("TopK", &[x, &count], vec![values.clone(), indices.clone()], attributes);
        (values, indices)
    }

    pub(super) fn cast_float(&mut self, x: &str) -> Value {
        self.with("Cast", &[x], vec![number("to", FLOAT.into())])
    }

    pub(super) fn softmax(&mut self, x: &str) -> Value {
        self.with("Softmax", &[x], vec![number("axis", -1)])
    }

    /// The first of the largest along the last axis.
    pub(super) fn argmax(&mut self, x: &str, keep: bool) -> Value {
        self.with("ArgMax", &[x], vec![number("axis", -1), number("keepdims", i64::from(keep))])
    }

    pub(super) fn layer_norm(&mut self, x: &str, scale: &str, shift: &str) -> Value {
        let epsilon = Attribute { name: "epsilon".into(), f: Some(1e-5), kind: 1, ..Attribute::default() };
        self.with("LayerNormalization", &[x, scale, shift], vec![number("axis", -1), epsilon])
    }

    /// √Σ x² along the last axis, which stays with size 1.
    pub(super) fn length(&mut self, x: &str) -> Value {
        let square = self.mul(x, x);
        let sum = self.sum(&square, -1, true);
        self.op("Sqrt", &[&sum])
    }

    pub(super) fn choose(&mut self, condition: &str, yes: &str, no: &str) -> Value {
        self.op("Where", &[condition, yes, no])
    }
}
