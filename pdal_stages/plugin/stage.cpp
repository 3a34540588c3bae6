// Stages of pdal_stages as stages of PDAL.
//
// A stage of this file computes nothing: it lets PDAL make a filters.python, which runs the Python package, and hands it
// the points. So there is one interpreter, the one of filters.python, and no Python API here. What stages there are, and
// which options they have, is in declarations.hpp, written by the package from its own declarations.
//
// Python is asked twice: when a pipeline is prepared, which dimensions the options ask for (all that is wrong with the
// options comes up here, before any point is read), and when the points are there.
//
// Compiles with PDAL 2.2 to 2.10.

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <deque>
#include <memory>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include <pdal/Filter.hpp>
#include <pdal/PipelineWriter.hpp>
#include <pdal/PluginHelper.hpp>
#include <pdal/PointTable.hpp>
#include <pdal/PointView.hpp>
#include <pdal/StageFactory.hpp>
#include <pdal/Writer.hpp>
#include <pdal/io/BufferReader.hpp>
#include <pdal/pdal_features.hpp>
#include <pdal/util/ProgramArgs.hpp>

#ifndef _WIN32
#include <dlfcn.h>
#endif

// What the package declares: VERSION, and STAGES with their options.
namespace declared
{

enum class Kind { Number, Integer, Boolean, List, Text };

struct Option
{
    const char *name;
    Kind kind;
    bool hasDefault;
    double number;
    const char *text;
    const char *help;
};

struct Stage
{
    const char *type;
    const char *digest;
    const char *summary;
    const char *link;
    const Option *options;
    std::size_t count;
    bool gathers; // makes one thing of all points, as PDAL's own writers do
};

#include "declarations.hpp"

constexpr std::size_t COUNT = sizeof(STAGES) / sizeof(Stage);

} // namespace declared

namespace
{

using namespace pdal;

// What filters.python runs. No exception may leave it: filters.python releases an exception twice.
const char *const SCRIPT = R"python(
def stage(ins, outs):
    try:
        from pdal_stages.plugin.calls import answer
    except BaseException as error:
        import sys
        global out_metadata
        if isinstance(error, ModuleNotFoundError) and error.name == "pdal_stages":
            what = "the Python that PDAL's filters.python runs has no package pdal_stages"
            cure = f"Install it there: {sys.prefix}/bin/python -m pip install pdal-stages"
        elif isinstance(error, ModuleNotFoundError) and str(error.name).startswith("pdal_stages."):
            what = f"the package pdal_stages is not of the version {pdalargs['version']} that this plugin was built for"
            cure = "Build the plugin again: pdal-stages plugin --install"
        else:
            what = "the package pdal_stages cannot be imported"
            cure = "Run: pdal-stages doctor"
        text = f"{pdalargs['stage']}: {what} (found Python {sys.version.split()[0]} of {sys.prefix}; "
        text += f"{type(error).__name__}: {error}). {cure}."
        leaf = {"name": "pdal_stages_error", "value": text, "type": "string", "description": ""}
        out_metadata = {"name": "pdal_stages", "value": "", "type": "string", "description": "", "children": [leaf]}
        return True
    return answer(globals(), ins, outs)
)python";

// Options of every PDAL stage that a stage of ours answers itself, where PDAL must not see them: its own `where` hides
// points, ours only chooses among them.
const std::vector<std::string> TAKEN { "where", "where_merge", "option_file" };

bool startsWith(const std::string& text, const std::string& start)
{
    return text.compare(0, start.size(), start) == 0;
}

std::string quoted(const std::string& text)
{
    std::string out = "\"";
    for (char c : text)
    {
        if (c == '"' || c == '\\')
            out += std::string("\\") + c;
        else if (static_cast<unsigned char>(c) < 0x20)
        {
            char code[8];
            std::snprintf(code, sizeof(code), "\\u%04x", static_cast<unsigned>(c));
            out += code;
        }
        else
            out += c;
    }
    return out + "\"";
}

// Keeps GDAL quiet while it lives. From 2.9 on PDAL asks GDAL of every option that it writes down whether it is a spatial
// reference, and shows the answer as an error. GDAL's functions are looked up: it is PDAL that is linked to it.
class QuietGdal
{
public:
    QuietGdal()
    {
#ifndef _WIN32
        const auto push = reinterpret_cast<void (*)(void *)>(dlsym(RTLD_DEFAULT, "CPLPushErrorHandler"));
        void *quiet = dlsym(RTLD_DEFAULT, "CPLQuietErrorHandler");
        m_pop = reinterpret_cast<void (*)()>(dlsym(RTLD_DEFAULT, "CPLPopErrorHandler"));
        if (push && quiet && m_pop)
            push(quiet);
        else
            m_pop = nullptr;
#endif
    }
    ~QuietGdal()
    {
        if (m_pop)
            m_pop();
    }
    QuietGdal(const QuietGdal&) = delete;
    QuietGdal& operator=(const QuietGdal&) = delete;

private:
    void (*m_pop)() = nullptr;
};

std::string newLabel(const std::string& type)
{
    static std::atomic<unsigned> count { 0 };
    std::ostringstream out;
    out << "pdal_stages_" << type << "_" << std::hex
        << std::chrono::steady_clock::now().time_since_epoch().count() << "_" << ++count;
    std::string label = out.str();
    std::replace(label.begin(), label.end(), '.', '_');
    return label;
}

// How many views reach a stage's successor, unless something gathers them: one for each reader. The package decides by
// `_may_be_apart` (pipeline/expansion.py) from the pipeline's JSON.
size_t viewsOf(Stage& stage)
{
    const std::string name = stage.getName();
    if (startsWith(name, "readers.") || declared::NOT_GATHERED_AFTER.count(name))
        return 1;
    for (const declared::Stage& ours : declared::STAGES)
        if (name == ours.type)
            return 1;
    size_t count = 0;
    for (Stage *input : stage.getInputs())
        count += viewsOf(*input);
    return count;
}

// A table for the stages within a stage: the points, and what is known about them, are another table's, but metadata
// and spatial references of the stages within stay here.
class InnerTable : public BasePointTable
{
public:
    explicit InnerTable(BasePointTable& outer) : BasePointTable(*outer.layout()), m_outer(outer)
    {
        for (MetadataNode child : outer.metadata().children())
            metadata().add(child);
    }

    bool supportsView() const
        { return true; }
    void finalize()
        { m_outer.finalize(); }

private:
    BasePointTable& m_outer;

    // Nobody makes points here.
    PointId addPoint()
        { throw pdal_error("pdal_stages: points cannot be added"); }
    char *getDimension(const Dimension::Detail *, PointId)
        { return nullptr; }
    char *getPoint(PointId)
        { return nullptr; }
    void setFieldInternal(Dimension::Id, PointId, const void *)
        { throw pdal_error("pdal_stages: points cannot be added"); }
    void getFieldInternal(Dimension::Id, PointId, void *) const
        { throw pdal_error("pdal_stages: points cannot be read"); }
};

// Let Python work on views; what it answers, as nodes. An error of Python's is thrown as PDAL's.
MetadataNodeList ask(const std::string& type, const std::string& label, const std::string& request,
    const std::vector<PointViewPtr>& views, PointTableRef table, LogPtr log)
{
    StageFactory factory;
    Stage *python = factory.createStage("filters.python");
    if (!python)
        throw pdal_error(type + ": PDAL has no filters.python, which runs this stage. It comes with pdal-plugins "
            "(conda install -c conda-forge pdal-plugins, or pip install pdal-plugins); set PDAL_DRIVER_PATH to the "
            "folder that holds libpdal_plugin_filter_python.");
    BufferReader reader;
    for (const PointViewPtr& view : views)
        reader.addView(view);
    Options options;
    options.add("module", label);
    options.add("function", "stage");
    options.add("source", std::string(SCRIPT));
    options.add("pdalargs", request);
    reader.setLog(log);
    python->setLog(log);
    python->setOptions(options);
    python->setInput(reader);
    python->prepare(table);
    python->execute(table);

    // filters.python puts the children of what a script says into a node of that name.
    MetadataNodeList answer;
    for (MetadataNode part : python->getMetadata().children("children"))
        for (MetadataNode leaf : part.children())
        {
            if (leaf.name() == "pdal_stages_error")
                throw pdal_error(leaf.value());
            if (leaf.name() == "pdal_stages_warning")
                log->get(LogLevel::Warning) << leaf.value() << std::endl;
            else
                answer.push_back(leaf);
        }
    return answer;
}

// A filter or writer of PDAL that is one of our stages.
template<typename Base>
class Native : public Base
{
public:
    explicit Native(const declared::Stage& declaration) : m_declared(declaration), m_label(newLabel(declaration.type))
    {}

    std::string getName() const
        { return m_declared.type; }

private:
    // What PDAL's parser writes an option's value to. Python gets the text; PDAL checks its type and shows its default.
    struct Bound
    {
        double number;
        std::int64_t integer;
        bool boolean;
        std::string text;
        StringList list;
    };

    const declared::Stage& m_declared;
    std::string m_label;
    std::deque<Bound> m_bound; // PDAL's parser keeps addresses of its elements, which a vector would move
    Options m_held;
    std::string m_request;
    BasePointTable *m_table = nullptr;
    bool m_gather = false;
    PointViewPtr m_gathered;
    std::vector<PointViewPtr> m_views;
    std::vector<std::pair<std::string, Dimension::Type>> m_dimensions;

    virtual void addArgs(ProgramArgs& args)
    {
        m_bound.clear();
        for (const declared::Option *o = m_declared.options; o != m_declared.options + m_declared.count; ++o)
        {
            m_bound.emplace_back();
            try
            {
                add(args, *o, m_bound.back());
            }
            catch (const arg_error&)
            {} // writers of newer PDAL have `filename` and `where` already
        }
        holdBack();
    }

    static void add(ProgramArgs& args, const declared::Option& o, Bound& to)
    {
        switch (o.kind)
        {
        case declared::Kind::Number:
            o.hasDefault ? args.add(o.name, o.help, to.number, o.number) : args.add(o.name, o.help, to.number);
            break;
        case declared::Kind::Integer:
            o.hasDefault ? args.add(o.name, o.help, to.integer, static_cast<std::int64_t>(o.number)) :
                args.add(o.name, o.help, to.integer);
            break;
        case declared::Kind::Boolean:
            args.add(o.name, o.help, to.boolean, o.number != 0);
            break;
        case declared::Kind::List:
            o.hasDefault ? args.add(o.name, o.help, to.list, Utils::split2(std::string(o.text), ',')) :
                args.add(o.name, o.help, to.list);
            break;
        case declared::Kind::Text:
            o.hasDefault ? args.add(o.name, o.help, to.text, std::string(o.text)) :
                args.add(o.name, o.help, to.text);
            break;
        }
    }

    // Keep from PDAL's parser what it must not see, until it is done.
    void holdBack()
    {
        giveBack();
        for (const std::string& name : TAKEN)
            hold(name);
        // An empty list means "none", PDAL's parser refuses it.
        for (const declared::Option *o = m_declared.options; o != m_declared.options + m_declared.count; ++o)
            if (o->kind == declared::Kind::List && this->m_options.getValues(o->name) == StringList { "" })
                hold(o->name);
    }

    void hold(const std::string& name)
    {
        for (const Option& option : this->m_options.getOptions(name))
            m_held.add(option);
        this->m_options.remove(Option(name, 0));
    }

    void giveBack()
    {
        this->addConditionalOptions(m_held);
        m_held = Options();
    }

    virtual void initialize()
    {
        giveBack();
        m_request = described();
        PointTable table;
        table.layout()->registerDim(Dimension::Id::X);
        table.layout()->registerDim(Dimension::Id::Y);
        table.layout()->registerDim(Dimension::Id::Z);
        table.finalize();
        PointViewPtr view(new PointView(table)); // PDAL 2.9 calls no filter where there are no points
        view->setField(Dimension::Id::X, 0, 0.0);
        m_dimensions.clear();
        for (MetadataNode& leaf : ask(getName(), m_label, request("prepare"), { view }, table, this->log()))
            if (leaf.name() == "dimension")
            {
                const StringList parts = Utils::split2(leaf.value(), '=');
                m_dimensions.emplace_back(parts.at(0), Dimension::type(parts.at(1)));
            }
    }

    virtual void addDimensions(PointLayoutPtr layout)
    {
        for (const auto& dimension : m_dimensions)
            layout->registerOrAssignDim(dimension.first, dimension.second);
    }

    virtual void ready(PointTableRef table)
    {
        size_t reaching = 0;
        for (Stage *input : this->getInputs())
            reaching += viewsOf(*input);
        m_table = &table;
        m_gather = reaching > 1; // points of several readers must see each other
        m_gathered.reset();
        m_views.clear();
    }

    virtual void prerun(const PointViewSet& views)
    {
        m_views.assign(views.begin(), views.end());
        m_gather = m_gather || (m_declared.gathers && views.size() > 1);
    }

    virtual PointViewSet run(PointViewPtr view)
    {
        PointViewSet out;
        if (m_gather && m_gathered)
            return out; // its points are in the first one's view
        if (m_gather)
        {
            m_gathered = merged();
            view = m_gathered;
        }
        InnerTable table(*m_table);
        for (MetadataNode& leaf : ask(getName(), m_label, request("run"), { view }, table, this->log()))
            this->m_metadata.add(leaf);
        out.insert(view);
        return out;
    }

    virtual void done(PointTableRef)
    {
        m_gathered.reset();
        m_views.clear();
        m_table = nullptr;
    }

    // All views as one, as filters.merge makes it.
    PointViewPtr merged()
    {
        SpatialReference srs = this->getSpatialReference();
        if (srs.empty())
            srs = m_table->anySpatialReference();
        PointViewPtr all(new PointView(*m_table, srs));
        for (const PointViewPtr& view : m_views)
        {
            if (view->spatialReference() != srs)
                this->log()->get(LogLevel::Warning) << "merging points with inconsistent spatial references." <<
                    std::endl;
            all->append(*view);
        }
        return all;
    }

    // What Python is told in either step, without the closing brace.
    std::string described()
    {
        std::ostringstream before;
        {
            QuietGdal quiet;
            PipelineWriter::writePipeline(this, before);
        }
        std::ostringstream out;
        out << "\"stage\":" << quoted(getName()) << ",\"label\":" << quoted(m_label) << ",\"tag\":" <<
            quoted(this->tag()) << ",\"version\":" << quoted(declared::VERSION) << ",\"digest\":" <<
            quoted(m_declared.digest) << ",\"pipeline\":" << quoted(before.str()) << ",\"options\":[";
        const char *comma = "";
        for (const Option& option : this->m_options.getOptions())
        {
            out << comma << "[" << quoted(option.getName()) << "," << quoted(option.getValue()) << "]";
            comma = ",";
        }
        out << "]";
        return out.str();
    }

    std::string request(const std::string& step) const
        { return "{\"step\":" + quoted(step) + "," + m_request + "}"; }
};

// PDAL makes stages without arguments.
template<size_t I>
class NativeFilter : public Native<Filter>
{
public:
    NativeFilter() : Native<Filter>(declared::STAGES[I])
    {}
};

template<size_t I>
class NativeWriter : public Native<Writer>
{
public:
    NativeWriter() : Native<Writer>(declared::STAGES[I])
    {}
};

template<size_t I>
void registerStage()
{
    const declared::Stage& stage = declared::STAGES[I];
    const PluginInfo info(stage.type, stage.summary, stage.link);
    if (startsWith(stage.type, "writers."))
        PluginManager<Stage>::registerPlugin<NativeWriter<I>>(info);
    else
        PluginManager<Stage>::registerPlugin<NativeFilter<I>>(info);
}

template<size_t... I>
void registerStages(std::index_sequence<I...>)
{
    (registerStage<I>(), ...);
}

} // unnamed namespace

#ifdef _WIN32
#define PDAL_STAGES_VISIBLE __declspec(dllexport)
#else
#define PDAL_STAGES_VISIBLE __attribute__((visibility("default")))
#endif

// PDAL's loader looks for filters.NAME in libpdal_plugin_filter_NAME, and calls this: the library lies there under the name
// of each of its stages, and makes all of them known, whichever was asked for.
extern "C" PDAL_STAGES_VISIBLE void PF_initPlugin()
{
    registerStages(std::make_index_sequence<declared::COUNT>());
}
